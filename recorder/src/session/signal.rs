//! A recorded signal as `session.toml` lists it.

use depthrig_bus::{SignalDescription, StreamId};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// One recorded signal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Text", into = "Text")]
pub struct SignalRecord {
    /// Its name, such as `arm/joint_position`. No camera's stream has the same one, so that topics and accounts differ.
    pub id: StreamId,
    /// Its fields, as every sample carries them.
    pub description: Arc<SignalDescription>,
}

/// The table `[[signals]]`.
#[derive(Serialize, Deserialize)]
struct Text {
    id: StreamId,
    /// JSON.
    description: String,
}

impl SignalRecord {
    /// The record of a signal with this description.
    pub fn new(description: &Arc<SignalDescription>) -> Self {
        let name = description.name();
        let id = StreamId { camera: name.device().clone(), stream: name.signal().clone() };
        Self { id, description: Arc::clone(description) }
    }
}

impl From<SignalRecord> for Text {
    fn from(record: SignalRecord) -> Self {
        Self { id: record.id, description: record.description.json().to_owned() }
    }
}

impl TryFrom<Text> for SignalRecord {
    type Error = String;

    fn try_from(text: Text) -> Result<Self, String> {
        let description = SignalDescription::parse(text.description.as_bytes()).map_err(|e| e.to_string())?;
        let record = Self::new(&Arc::new(description));
        if record.id != text.id {
            return Err(format!("the description of signal {} names {}", text.id, record.id));
        }
        Ok(record)
    }
}
