//! `std_srvs/srv/Trigger`, the service that viewers call: its two messages, and the response in CDR.

use crate::cdr::Writer;

/// Name of the service's type.
pub const TYPE: &str = "std_srvs/srv/Trigger";
/// Name of the request's type.
pub const REQUEST_TYPE: &str = "std_srvs/srv/Trigger_Request";
/// Definition of the request: empty, which ROS 2 writes as one byte.
pub const REQUEST: &str = "uint8 structure_needs_at_least_one_member\n";
/// Name of the response's type.
pub const RESPONSE_TYPE: &str = "std_srvs/srv/Trigger_Response";
/// Definition of the response.
pub const RESPONSE: &str = "bool success\nstring message\n";

/// The response.
pub fn response(success: bool, message: &str) -> Vec<u8> {
    let mut out = Vec::new();
    Writer::new(&mut out).u8(success.into()).str(message);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_response_is_a_byte_and_a_string() {
        assert_eq!(response(true, "ab"), [0, 1, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0, b'a', b'b', 0]);
    }
}
