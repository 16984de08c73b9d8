//! Messages of the Foxglove WebSocket protocol (<https://github.com/foxglove/ws-protocol>), as far as a viewer needs them. The two sub-protocols do not differ in these.

use serde::{Deserialize, Serialize};

/// The sub-protocols that are spoken, of Foxglove and of Lichtblick.
pub(crate) const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Bytes before the message of a channel: opcode, subscription, time.
pub(crate) const MESSAGE_HEAD_BYTES: usize = 13;

/// First byte of a binary message of the server.
mod from_server {
    pub(super) const MESSAGE: u8 = 1;
    pub(super) const SERVICE_RESPONSE: u8 = 3;
}

/// First byte of a binary message of a client.
const SERVICE_REQUEST: u8 = 2;

/// A text message of the server.
#[derive(Debug, Serialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub(crate) enum ToClient<'a> {
    /// First of all.
    ServerInfo {
        name: String,
        capabilities: &'a [&'a str],
        supported_encodings: &'a [&'a str],
        session_id: String,
    },
    Advertise {
        channels: Vec<Channel<'a>>,
    },
    Unadvertise {
        channel_ids: Vec<u32>,
    },
    AdvertiseServices {
        services: Vec<Service<'a>>,
    },
    /// 0: to know; 1: a warning; 2: an error.
    Status {
        level: u8,
        message: String,
    },
    ServiceCallFailure {
        service_id: u32,
        call_id: u32,
        message: String,
    },
}

/// A channel that a client may subscribe to.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Channel<'a> {
    pub id: u32,
    pub topic: &'a str,
    pub encoding: &'static str,
    pub schema_name: &'a str,
    pub schema: &'a str,
    pub schema_encoding: &'static str,
}

/// A service that a client may call.
#[derive(Debug, Serialize)]
pub(crate) struct Service<'a> {
    pub id: u32,
    pub name: &'a str,
    #[serde(rename = "type")]
    pub kind: &'static str,
    pub request: Schema<'a>,
    pub response: Schema<'a>,
}

/// The form of a request or a response.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
#[allow(clippy::struct_field_names)] // the protocol's names
pub(crate) struct Schema<'a> {
    pub encoding: &'static str,
    pub schema_name: &'static str,
    pub schema_encoding: &'static str,
    pub schema: &'a str,
}

/// A text message of a client.
#[derive(Debug, PartialEq, Eq, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub(crate) enum FromClient {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
    /// One of a capability that is not offered.
    #[serde(other)]
    Other,
}

/// A subscription, under a number that the client chose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Subscription {
    pub id: u32,
    pub channel_id: u32,
}

/// A call of a service.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct ServiceCall {
    pub service: u32,
    pub call: u32,
    pub encoding: String,
}

impl ServiceCall {
    /// Reads the call; its request has nothing to say. `None` for anything else.
    pub(crate) fn read(message: &[u8]) -> Option<Self> {
        let (head, rest) = message.split_first_chunk::<13>()?;
        let number = |at: usize| head.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes);
        if head[0] != SERVICE_REQUEST {
            return None;
        }
        let encoding = rest.get(..number(9)? as usize)?;
        let encoding = core::str::from_utf8(encoding).ok()?.to_owned();
        Some(Self { service: number(1)?, call: number(5)?, encoding })
    }

    /// The response to it.
    pub(crate) fn response(&self, payload: &[u8]) -> Vec<u8> {
        let mut out = vec![from_server::SERVICE_RESPONSE];
        for number in [self.service, self.call, self.encoding.len() as u32] {
            out.extend(number.to_le_bytes());
        }
        out.extend(self.encoding.as_bytes());
        out.extend(payload);
        out
    }
}

/// The message of a channel for the holder of a subscription.
pub(crate) fn message(subscription: u32, time_ns: i64, payload: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(MESSAGE_HEAD_BYTES + payload.len());
    out.push(from_server::MESSAGE);
    out.extend(subscription.to_le_bytes());
    out.extend(u64::try_from(time_ns).unwrap_or(0).to_le_bytes());
    out.extend(payload);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_messages_are_those_of_the_protocol() {
        let text = |m: &ToClient<'_>| serde_json::to_string(m).unwrap();
        assert_eq!(
            text(&ToClient::ServerInfo {
                name: "a".into(),
                capabilities: &["services"],
                supported_encodings: &["cdr"],
                session_id: "7".into()
            }),
            r#"{"op":"serverInfo","name":"a","capabilities":["services"],"supportedEncodings":["cdr"],"sessionId":"7"}"#
        );
        assert_eq!(
            text(&ToClient::Unadvertise { channel_ids: vec![1, 2] }),
            r#"{"op":"unadvertise","channelIds":[1,2]}"#
        );
        let read = |text: &str| serde_json::from_str::<FromClient>(text).unwrap();
        assert_eq!(
            read(r#"{"op":"subscribe","subscriptions":[{"id":3,"channelId":4}]}"#),
            FromClient::Subscribe { subscriptions: vec![Subscription { id: 3, channel_id: 4 }] }
        );
        assert_eq!(
            read(r#"{"op":"unsubscribe","subscriptionIds":[3]}"#),
            FromClient::Unsubscribe { subscription_ids: vec![3] }
        );
        assert_eq!(read(r#"{"op":"getParameters","parameterNames":[]}"#), FromClient::Other);
        assert!(serde_json::from_str::<FromClient>("[]").is_err());
    }

    #[test]
    fn binary_messages_are_those_of_the_protocol() {
        assert_eq!(message(0x0102, 3, b"ab"), [1, 2, 1, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0, b'a', b'b']);
        let call = [&[2, 7, 0, 0, 0, 9, 0, 0, 0, 3, 0, 0, 0][..], b"cdr", &[0, 1, 0, 0, 0]].concat();
        let read = ServiceCall::read(&call).unwrap();
        assert_eq!(read, ServiceCall { service: 7, call: 9, encoding: "cdr".into() });
        assert_eq!(read.response(b"x"), [&[3, 7, 0, 0, 0, 9, 0, 0, 0, 3, 0, 0, 0][..], b"cdrx"].concat());
        for end in 0..16 {
            assert_eq!(ServiceCall::read(&call[..end]), None, "{end}");
        }
        assert_eq!(ServiceCall::read(&[1; 40]), None, "a client publishes nothing");
    }
}
