//! Puts nodes and constants together to a graph; knows nothing of the network.

use super::proto::{
    self, AttributeProto, DimensionProto, GraphProto, ModelProto, NodeProto, OperatorSetIdProto,
    StringStringEntryProto, TensorProto, TensorShapeProto, TensorTypeProto, TypeProto, ValueInfoProto,
};
use super::{Graph, Numbers, WeightSlice};
use core::ops::Range;
use prost::Message;
use std::collections::{BTreeMap, BTreeSet};

/// ONNX's own operators: set 20 has `Gelu`, and every ONNX Runtime from 1.17 on knows it.
const OPSET: i64 = 20;
/// The format of the file that goes with it.
const IR_VERSION: i64 = 9;
/// The domain of the operators that only ONNX Runtime has.
pub const CONTRIB: &str = "com.microsoft";

/// A value of the graph, by name. The empty name is an input that is left out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Value(String);

impl Value {
    /// An input of the graph, or one that is left out.
    pub fn named(name: &str) -> Self {
        Self(name.into())
    }

    /// An optional input that is not given.
    pub const fn none() -> Self {
        Self(String::new())
    }
}

/// A setting of an operation.
#[derive(Debug, Clone, Copy)]
pub enum Attribute<'a> {
    /// A whole number.
    Int(i64),
    /// A number.
    Float(f32),
    /// Several whole numbers.
    Ints(&'a [i64]),
    /// A word.
    Text(&'a str),
}

/// A dimension of an input or output.
#[derive(Debug, Clone, Copy)]
pub enum Dimension<'a> {
    /// Known now.
    Fixed(usize),
    /// Known when the graph runs.
    Named(&'a str),
}

/// A graph that is being made.
#[derive(Debug)]
pub struct Builder {
    nodes: Vec<NodeProto>,
    initializers: Vec<TensorProto>,
    known: BTreeSet<String>,
    weights: Vec<WeightSlice>,
    shapes: BTreeMap<String, Vec<usize>>,
    inputs: Vec<ValueInfoProto>,
    outputs: Vec<ValueInfoProto>,
    numbers: Numbers,
}

impl Builder {
    /// An empty graph over the tensors with these names and shapes, computing in `numbers`.
    pub fn new(shapes: BTreeMap<String, Vec<usize>>, numbers: Numbers) -> Self {
        Self {
            nodes: Vec::new(),
            initializers: Vec::new(),
            known: BTreeSet::new(),
            weights: Vec::new(),
            shapes,
            inputs: Vec::new(),
            outputs: Vec::new(),
            numbers,
        }
    }

    /// Appends an operation with one output.
    pub fn op(&mut self, op: &str, inputs: &[&Value], attributes: &[(&str, Attribute<'_>)]) -> Value {
        self.op_in("", op, inputs, attributes)
    }

    /// The same with an operator of another domain.
    pub fn op_in(
        &mut self,
        domain: &str,
        op: &str,
        inputs: &[&Value],
        attributes: &[(&str, Attribute<'_>)],
    ) -> Value {
        let output = format!("{op}_{}", self.nodes.len());
        self.node(domain, op, inputs, &output, attributes);
        Value(output)
    }

    fn node(
        &mut self,
        domain: &str,
        op: &str,
        inputs: &[&Value],
        output: &str,
        attributes: &[(&str, Attribute<'_>)],
    ) {
        self.nodes.push(NodeProto {
            input: inputs.iter().map(|v| v.0.clone()).collect(),
            output: vec![output.to_owned()],
            name: Some(format!("{op}_{}", self.nodes.len())),
            op_type: Some(op.into()),
            attribute: attributes.iter().map(|(name, a)| attribute(name, *a)).collect(),
            domain: (!domain.is_empty()).then(|| domain.into()),
        });
    }

    /// A whole tensor of the checkpoint, in 32-bit floats.
    pub fn raw(&mut self, name: &str) -> Value {
        let shape = self.shape(name);
        self.raw_as(name, &shape)
    }

    /// The same in another shape of as many numbers.
    pub fn raw_as(&mut self, name: &str, shape: &[usize]) -> Value {
        let all = 0..self.shape(name).first().copied().unwrap_or(0);
        self.slice(name, all, shape.to_vec())
    }

    /// Rows of a tensor of the checkpoint: they lie together in the file.
    pub fn raw_rows(&mut self, name: &str, rows: Range<usize>) -> Value {
        let mut shape = self.shape(name);
        if let Some(first) = shape.first_mut() {
            *first = rows.len();
        }
        self.slice(name, rows, shape)
    }

    fn shape(&self, name: &str) -> Vec<usize> {
        debug_assert!(self.shapes.contains_key(name), "no tensor {name}");
        self.shapes.get(name).cloned().unwrap_or_default()
    }

    fn slice(&mut self, name: &str, rows: Range<usize>, shape: Vec<usize>) -> Value {
        let whole = self.shape(name).first().is_some_and(|n| rows == (0..*n));
        let key = if whole { name.to_owned() } else { format!("{name}[{}:{}]", rows.start, rows.end) };
        if self.known.insert(key.clone()) {
            // Where the numbers are is only known to who runs the graph; the format wants a place all the same.
            let location =
                StringStringEntryProto { key: Some("location".into()), value: Some("checkpoint".into()) };
            self.initializers.push(TensorProto {
                dims: shape.iter().map(|n| *n as i64).collect(),
                data_type: Some(proto::FLOAT),
                name: Some(key.clone()),
                external_data: vec![location],
                data_location: Some(proto::EXTERNAL),
                raw_data: None,
            });
            self.weights.push(WeightSlice { initializer: key.clone(), tensor: name.into(), rows, shape });
        }
        Value(key)
    }

    /// `value`, which is in 32-bit floats, in the numbers that the graph computes in. Of a constant, the engine does it
    /// once while it loads.
    pub fn cast(&mut self, value: Value) -> Value {
        match self.numbers {
            Numbers::Fp32 => value,
            Numbers::Fp16 => self.op("Cast", &[&value], &[("to", Attribute::Int(proto::FLOAT16.into()))]),
        }
    }

    /// `value` in 32-bit floats.
    pub fn uncast(&mut self, value: Value) -> Value {
        match self.numbers {
            Numbers::Fp32 => value,
            Numbers::Fp16 => self.op("Cast", &[&value], &[("to", Attribute::Int(proto::FLOAT.into()))]),
        }
    }

    /// A tensor of the checkpoint, ready to compute with.
    pub fn weight(&mut self, name: &str) -> Value {
        let raw = self.raw(name);
        self.cast(raw)
    }

    /// A list of whole numbers.
    pub fn ints(&mut self, numbers: &[i64]) -> Value {
        let name = format!("ints{numbers:?}");
        let raw = numbers.iter().flat_map(|n| n.to_le_bytes()).collect();
        self.constant(name, proto::INT64, &[numbers.len() as i64], raw)
    }

    /// One 32-bit float.
    pub fn float(&mut self, number: f32) -> Value {
        self.constant(format!("float({number})"), proto::FLOAT, &[], number.to_le_bytes().to_vec())
    }

    fn constant(&mut self, name: String, data_type: i32, dims: &[i64], raw: Vec<u8>) -> Value {
        if self.known.insert(name.clone()) {
            self.initializers.push(TensorProto {
                dims: dims.to_vec(),
                data_type: Some(data_type),
                name: Some(name.clone()),
                raw_data: Some(raw),
                external_data: Vec::new(),
                data_location: None,
            });
        }
        Value(name)
    }

    /// An input of 32-bit floats.
    pub fn input(&mut self, name: &str, shape: &[Dimension<'_>]) -> Value {
        self.inputs.push(value_info(name, shape));
        Value::named(name)
    }

    /// Makes `value`, in 32-bit floats, an output.
    pub fn output(&mut self, name: &str, value: &Value, shape: &[Dimension<'_>]) {
        self.node("", "Identity", &[value], name, &[]);
        self.outputs.push(value_info(name, shape));
    }

    /// The graph as a file.
    pub fn finish(self, name: &str) -> Graph {
        let opset = |domain: &str, version| OperatorSetIdProto {
            domain: Some(domain.into()),
            version: Some(version),
        };
        let contrib = self.nodes.iter().any(|n| n.domain.as_deref() == Some(CONTRIB));
        let mut opset_import = vec![opset("", OPSET)];
        opset_import.extend(contrib.then(|| opset(CONTRIB, 1)));
        let model = ModelProto {
            ir_version: Some(IR_VERSION),
            producer_name: Some("depthrig".into()),
            graph: Some(GraphProto {
                node: self.nodes,
                name: Some(name.into()),
                initializer: self.initializers,
                input: self.inputs,
                output: self.outputs,
            }),
            opset_import,
        };
        Graph { model: model.encode_to_vec(), weights: self.weights }
    }
}

fn attribute(name: &str, value: Attribute<'_>) -> AttributeProto {
    // AttributeProto.AttributeType
    let float = 1;
    let int = 2;
    let string = 3;
    let several = 7;
    let base = AttributeProto { name: Some(name.into()), ..Default::default() };
    match value {
        Attribute::Float(f) => AttributeProto { f: Some(f), kind: Some(float), ..base },
        Attribute::Int(i) => AttributeProto { i: Some(i), kind: Some(int), ..base },
        Attribute::Text(s) => AttributeProto { s: Some(s.as_bytes().to_vec()), kind: Some(string), ..base },
        Attribute::Ints(ints) => AttributeProto { ints: ints.to_vec(), kind: Some(several), ..base },
    }
}

fn value_info(name: &str, shape: &[Dimension<'_>]) -> ValueInfoProto {
    let dim = shape.iter().map(|d| match d {
        Dimension::Fixed(n) => DimensionProto { dim_value: Some(*n as i64), dim_param: None },
        Dimension::Named(s) => DimensionProto { dim_value: None, dim_param: Some((*s).into()) },
    });
    let tensor_type = TensorTypeProto {
        elem_type: Some(proto::FLOAT),
        shape: Some(TensorShapeProto { dim: dim.collect() }),
    };
    ValueInfoProto { name: Some(name.into()), r#type: Some(TypeProto { tensor_type: Some(tensor_type) }) }
}
