//! Keys of a terminal, apart from the escape sequences between them: pasted text, late answers to questions.

const ESC: u8 = 0x1b;
const BEL: u8 = 0x07;

/// A key that was pressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Key {
    /// One that sends a byte of its own.
    Byte(u8),
    /// The left arrow.
    Left,
    /// The right arrow.
    Right,
    /// Esc.
    Escape,
}

impl Key {
    /// The letter on it in lower case, if there is one.
    pub const fn letter(self) -> Option<char> {
        match self {
            Self::Byte(byte) if byte.is_ascii() => Some(byte.to_ascii_lowercase() as char),
            _ => None,
        }
    }
}

/// Separates keys from escape sequences (ECMA-48), byte by byte.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Keys {
    /// Between sequences.
    #[default]
    Plain,
    /// After ESC.
    Escape,
    /// At the beginning of a control sequence, which ends with a letter or a sign.
    Control,
    /// Behind a parameter of a control sequence.
    Parameters,
    /// In a string, such as an answer about images, which ends with BEL or ESC \.
    Text,
    /// After ESC in a string.
    TextEscape,
}

impl Keys {
    /// The key that a byte is, if it is one.
    pub fn next(&mut self, byte: u8) -> Option<Key> {
        let arrow = match (*self, byte) {
            (Self::Control, b'C') => Some(Key::Right),
            (Self::Control, b'D') => Some(Key::Left),
            _ => None,
        };
        let state = match *self {
            Self::Plain if byte != ESC => return Some(Key::Byte(byte)),
            Self::Plain => Self::Escape,
            Self::Escape => match byte {
                ESC => Self::Escape,
                b'[' | b'O' => Self::Control,
                b'_' | b'P' | b']' | b'^' | b'X' => Self::Text,
                _ => Self::Plain,
            },
            Self::Control | Self::Parameters if (0x40..=0x7e).contains(&byte) => Self::Plain,
            Self::Control | Self::Parameters => Self::Parameters,
            Self::Text => match byte {
                ESC => Self::TextEscape,
                BEL => Self::Plain,
                _ => Self::Text,
            },
            Self::TextEscape if byte == b'\\' => Self::Plain,
            Self::TextEscape => Self::Text,
        };
        *self = state;
        arrow
    }

    /// Whether the last byte was ESC, which is a key if nothing follows.
    pub fn is_at_escape(self) -> bool {
        self == Self::Escape
    }

    /// The key that ESC is when nothing has followed it.
    pub fn end_of_escape(&mut self) -> Option<Key> {
        let is_key = self.is_at_escape();
        if is_key {
            *self = Self::Plain;
        }
        is_key.then_some(Key::Escape)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(bytes: &[u8]) -> Vec<u8> {
        let mut keys = Keys::default();
        let pressed = bytes.iter().filter_map(|b| keys.next(*b));
        pressed.filter_map(|key| if let Key::Byte(byte) = key { Some(byte) } else { None }).collect()
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
    #[test]
    fn arrows_and_escape_are_keys() {
        let mut keys = Keys::default();
        let pressed: Vec<Key> =
            b"\x1b[C\x1bOD\x1b[1;5C\x1b[?62;4DN".iter().filter_map(|b| keys.next(*b)).collect();
        assert_eq!(pressed, [Key::Right, Key::Left, Key::Byte(b'N')]);
        assert_eq!(keys.end_of_escape(), None);
        assert_eq!(keys.next(0x1b), None);
        assert!(keys.is_at_escape());
        assert_eq!((keys.end_of_escape(), keys.next(b'[')), (Some(Key::Escape), Some(Key::Byte(b'['))));
        assert_eq!([Key::Byte(b'N').letter(), Key::Left.letter()], [Some('n'), None]);
    }
}
