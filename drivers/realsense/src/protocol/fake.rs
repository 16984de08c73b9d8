//! A camera for tests: it answers requests as bytes, by what a test says.

use super::hwm::{Code, HardwareMonitor, Received, Request, build_refusal, build_reply, reply_data};
use depthrig_driver::Result;

/// Answers each request with data or a refusal, and keeps what it was asked.
pub struct Fake<F> {
    /// Opcode and parameters of every request so far.
    pub asked: Vec<(u32, [u32; 4])>,
    answer: F,
}

impl<F: FnMut(&Received<'_>) -> Result<Vec<u8>, Code>> Fake<F> {
    pub fn new(answer: F) -> Self {
        Self { asked: Vec::new(), answer }
    }
}

impl<F: FnMut(&Received<'_>) -> Result<Vec<u8>, Code> + Send> HardwareMonitor for Fake<F> {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        let bytes = request.to_bytes();
        let received = Received::parse(&bytes)?;
        self.asked.push((received.opcode, received.params));
        let reply = match (self.answer)(&received) {
            Ok(data) => build_reply(received.opcode, &data),
            Err(code) => build_refusal(code),
        };
        reply_data(request, &reply).map(<[u8]>::to_vec)
    }
}

/// A D400 with advanced mode, whose groups can be read and written; the depth table is limited to 100…10 000 µm.
pub fn advanced(on: bool) -> Fake<impl FnMut(&Received<'_>) -> Result<Vec<u8>, Code> + Send> {
    let mut groups: Vec<Vec<u8>> =
        super::advanced::Group::ALL.iter().map(|g| vec![*g as u8; g.bytes()]).collect();
    let table = |unit: u32| {
        [unit.to_le_bytes(), [0; 4], 65_535u32.to_le_bytes(), [0; 4], 9u32.to_le_bytes()].concat()
    };
    groups[9] = table(1000);
    Fake::new(move |r| match (r.opcode, r.params) {
        (0x30, _) => Ok(vec![on.into(), 0, 0, 0]),
        _ if !on => Err(Code::NOT_SUPPORTED),
        (0x2C, [9, 1, ..]) => Ok(table(100)),
        (0x2C, [9, 2, ..]) => Ok(table(10_000)),
        (0x2C, [group, 0, ..]) => groups.get(group as usize).cloned().ok_or(Code::WRONG_PARAMETER),
        (0x2B, [group, ..]) => {
            let group = groups.get_mut(group as usize).ok_or(Code::WRONG_PARAMETER)?;
            if group.len() != r.data.len() {
                return Err(Code::WRONG_PARAMETER);
            }
            *group = r.data.to_vec();
            Ok(Vec::new())
        }
        _ => Err(Code::WRONG_COMMAND),
    })
}
