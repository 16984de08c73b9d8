//! Keys of a terminal, apart from the escape sequences between them: arrows, pasted text, late answers to questions.

const ESC: u8 = 0x1b;
const BEL: u8 = 0x07;

/// Separates keys from escape sequences (ECMA-48), byte by byte.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Keys {
    /// Between sequences.
    #[default]
    Plain,
    /// After ESC.
    Escape,
    /// In a control sequence, which ends with a letter or a sign.
    Control,
    /// In a string, such as an answer about images, which ends with BEL or ESC \.
    Text,
    /// After ESC in a string.
    TextEscape,
}

impl Keys {
    /// The key that a byte is, if it is one.
    pub fn next(&mut self, byte: u8) -> Option<u8> {
        let state = match *self {
            Self::Plain if byte != ESC => return Some(byte),
            Self::Plain => Self::Escape,
            Self::Escape => match byte {
                ESC => Self::Escape,
                b'[' | b'O' => Self::Control,
                b'_' | b'P' | b']' | b'^' | b'X' => Self::Text,
                _ => Self::Plain,
            },
            Self::Control if (0x40..=0x7e).contains(&byte) => Self::Plain,
            Self::Control => Self::Control,
            Self::Text => match byte {
                ESC => Self::TextEscape,
                BEL => Self::Plain,
                _ => Self::Text,
            },
            Self::TextEscape if byte == b'\\' => Self::Plain,
            Self::TextEscape => Self::Text,
        };
        *self = state;
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(bytes: &[u8]) -> Vec<u8> {
        let mut keys = Keys::default();
        bytes.iter().filter_map(|b| keys.next(*b)).collect()
    }

    #[test]
    fn sequences_are_no_keys() {
        assert_eq!(keys(b"iq"), b"iq");
        assert_eq!(keys(b"a\x1b[Ab\x1bOPc"), b"abc");
        // Late answers, to the question for kitty's protocol, the cell's size and the terminal's attributes.
        assert_eq!(keys(b"\x1b_Gi=31;OK\x1b\\q"), b"q");
        assert_eq!(keys(b"\x1b[6;20;10t\x1b[?62;4;22cq"), b"q");
        assert_eq!(keys(b"\x1b]0;title\x07q"), b"q");
        // The Escape key, and one with Alt.
        assert_eq!(keys(b"\x1b\x1bxq"), b"q");
    }
}
