use super::*;
use crate::uvc::control::{ControlPort, Query};
use core::time::Duration;
use std::collections::VecDeque;

fn hex(text: &str) -> Vec<u8> {
    text.split_whitespace().map(|b| u8::from_str_radix(b, 16).unwrap()).collect()
}
