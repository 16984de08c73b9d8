//! A validator for the part of OpenAPI 3.1 and JSON Schema that the document uses; a keyword that it does not know
//! fails the test, so that nothing goes unchecked.

use serde_json::{Map, Value};

pub struct Document(Value);

/// Keywords that say nothing about a value.
const TALK: [&str; 1] = ["description"];

impl Document {
    pub fn new(document: Value) -> Self {
        Self(document)
    }

    /// Every reference leads somewhere, every schema is used, every call is described in full.
    pub fn check_itself(&self) {
        let schemas = self.0["components"]["schemas"].as_object().unwrap();
        let text = self.0.to_string();
        for name in schemas.keys() {
            assert!(text.contains(&format!("\"#/components/schemas/{name}\"")), "{name} is not used");
        }
        self.check_references(&self.0);
        let mut ids = std::collections::BTreeSet::new();
        for (path, calls) in self.0["paths"].as_object().unwrap() {
            for (method, call) in calls.as_object().unwrap() {
                assert!(call["summary"].as_str().is_some_and(|s| s.len() > 8), "{method} {path}");
                assert!(ids.insert(call["operationId"].as_str().unwrap().to_owned()), "{method} {path}");
                for answer in call["responses"].as_object().unwrap().values() {
                    assert!(answer["description"].is_string(), "{method} {path}");
                }
            }
        }
    }

    fn check_references(&self, value: &Value) {
        match value {
            Value::Object(map) => {
                if let Some(reference) = map.get("$ref") {
                    self.resolve(reference);
                }
                map.values().for_each(|v| self.check_references(v));
            }
            Value::Array(list) => list.iter().for_each(|v| self.check_references(v)),
            _ => {}
        }
    }

    fn resolve(&self, reference: &Value) -> &Value {
        let pointer = reference.as_str().and_then(|r| r.strip_prefix('#')).unwrap();
        self.0.pointer(pointer).unwrap_or_else(|| panic!("{reference} leads nowhere"))
    }

    /// The answer of `method path` is described, media type and body included.
    pub fn check_answer(&self, method: &str, path: &str, status: u16, media_type: &str, body: &str) {
        let at = format!("{method} {path} {status}");
        let answer = &self.0["paths"][path][method.to_lowercase()]["responses"][status.to_string()];
        assert!(answer.is_object(), "{at} is not described");
        let Some(content) = answer.get("content") else {
            assert!(
                body.is_empty() && media_type.is_empty(),
                "{at} is described without a body: {media_type} {body}"
            );
            return;
        };
        let schema = &content[media_type]["schema"];
        assert!(schema.is_object(), "{at}: {media_type} is not described");
        let value = if media_type == "application/json" {
            serde_json::from_str(body).unwrap()
        } else {
            Value::String(body.to_owned())
        };
        if let Err(why) = self.fits(schema, &value) {
            panic!("{at}: {why}\n{body}");
        }
    }

    /// `value` fits the schema of this name.
    pub fn check_value(&self, schema: &str, value: &Value) {
        if let Err(why) = self.fits(&self.0["components"]["schemas"][schema], value) {
            panic!("{schema}: {why}\n{value}");
        }
    }

    fn fits(&self, schema: &Value, value: &Value) -> Result<(), String> {
        for (keyword, wanted) in schema.as_object().ok_or("a schema that is not an object")? {
            match keyword.as_str() {
                "$ref" => self.fits(self.resolve(wanted), value)?,
                "anyOf" => {
                    let tries: Vec<_> =
                        wanted.as_array().unwrap().iter().map(|s| self.fits(s, value)).collect();
                    if tries.iter().all(Result::is_err) {
                        return Err(format!("none of {tries:?}"));
                    }
                }
                "type" => {
                    let types = wanted.as_array().cloned().unwrap_or_else(|| vec![wanted.clone()]);
                    if !types.iter().any(|t| is_of(t.as_str().unwrap(), value)) {
                        return Err(format!("{value} is not of type {wanted}"));
                    }
                }
                "enum" if !wanted.as_array().unwrap().contains(value) => {
                    return Err(format!("{value} is not one of {wanted}"));
                }
                "minimum" if value.as_f64().is_some_and(|v| v < wanted.as_f64().unwrap()) => {
                    return Err(format!("{value} is below {wanted}"));
                }
                "items" => {
                    for (i, item) in value.as_array().into_iter().flatten().enumerate() {
                        self.fits(wanted, item).map_err(|e| format!("[{i}]: {e}"))?;
                    }
                }
                "required" => {
                    let Some(object) = value.as_object() else { continue };
                    if let Some(name) = names(wanted).find(|name| !object.contains_key(*name)) {
                        return Err(format!("{name} is missing"));
                    }
                }
                "properties" => {
                    for (name, schema) in wanted.as_object().unwrap() {
                        if let Some(v) = value.get(name) {
                            self.fits(schema, v).map_err(|e| format!("{name}: {e}"))?;
                        }
                    }
                }
                "additionalProperties" => self.fits_others(schema, wanted, value)?,
                "enum" | "minimum" => {}
                other => assert!(TALK.contains(&other), "this validator does not know {other}"),
            }
        }
        Ok(())
    }

    fn fits_others(&self, schema: &Value, wanted: &Value, value: &Value) -> Result<(), String> {
        let described = schema.get("properties").and_then(Value::as_object).cloned().unwrap_or_else(Map::new);
        let others =
            value.as_object().into_iter().flatten().filter(|(name, _)| !described.contains_key(*name));
        for (name, v) in others {
            match wanted {
                Value::Bool(false) => return Err(format!("{name} is not described")),
                schema => self.fits(schema, v).map_err(|e| format!("{name}: {e}"))?,
            }
        }
        Ok(())
    }
}

fn names(list: &Value) -> impl Iterator<Item = &str> {
    list.as_array().into_iter().flatten().filter_map(Value::as_str)
}

fn is_of(kind: &str, value: &Value) -> bool {
    match kind {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "null" => value.is_null(),
        "number" => value.is_number(),
        "integer" => value.is_i64() || value.is_u64(),
        other => panic!("no JSON type {other}"),
    }
}

#[test]
fn the_validator_refuses_what_it_should() {
    let document = Document::new(serde_json::json!({
        "s": {"type": "object", "additionalProperties": false, "required": ["a"], "properties": {
            "a": {"type": "integer", "minimum": 0}, "b": {"type": ["string", "null"]},
            "c": {"type": "array", "items": {"enum": ["x"]}}, "d": {"anyOf": [{"type": "null"}, {"type": "boolean"}]},
            "e": {"type": "object", "additionalProperties": {"type": "number"}}}}
    }));
    let fits = |text: &str| document.fits(&document.0["s"], &serde_json::from_str(text).unwrap()).is_ok();
    for good in [r#"{"a": 0}"#, r#"{"a": 1, "b": null, "c": ["x"], "d": true, "e": {"z": 0.5}}"#] {
        assert!(fits(good), "{good}");
    }
    for bad in [
        "[]",
        "{}",
        r#"{"a": -1}"#,
        r#"{"a": 0.5}"#,
        r#"{"a": 1, "b": 2}"#,
        r#"{"a": 1, "c": ["y"]}"#,
        r#"{"a": 1, "d": 0}"#,
        r#"{"a": 1, "e": {"z": ""}}"#,
        r#"{"a": 1, "f": 0}"#,
    ] {
        assert!(!fits(bad), "{bad}");
    }
}
