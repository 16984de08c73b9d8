//! CDR, the encoding of ROS 2 messages: little-endian, each primitive aligned to its size, counted from the
//! byte after the four-byte encapsulation header (OMG DDS-XTypes, plain CDR version 1).

use crate::{Error, ErrorKind, Result};

/// The encapsulation header of little-endian plain CDR.
pub const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// Appends a CDR message to a buffer.
pub struct Writer<'a> {
    buf: &'a mut Vec<u8>,
    origin: usize,
}

macro_rules! put {
    ($($name:ident: $t:ty),*) => {$(
        #[doc = concat!("Appends a `", stringify!($t), "`.")]
        pub fn $name(&mut self, v: $t) -> &mut Self {
            self.align(size_of::<$t>());
            self.buf.extend_from_slice(&v.to_le_bytes());
            self
        }
    )*};
}

impl<'a> Writer<'a> {
    /// Begins a message at the end of `buf`.
    pub fn new(buf: &'a mut Vec<u8>) -> Self {
        buf.extend_from_slice(&ENCAPSULATION);
        let origin = buf.len();
        Self { buf, origin }
    }

    put!(u8: u8, u16: u16, u32: u32, u64: u64, i32: i32, i64: i64, f32: f32, f64: f64);

    /// Appends a string: its length with the final NUL, the bytes, the NUL.
    pub fn str(&mut self, s: &str) -> &mut Self {
        self.u32(s.len() as u32 + 1);
        self.buf.extend_from_slice(s.as_bytes());
        self.buf.push(0);
        self
    }

    /// Appends bytes as they are: an `uint8[N]`.
    pub fn raw(&mut self, bytes: &[u8]) -> &mut Self {
        self.buf.extend_from_slice(bytes);
        self
    }

    /// Appends an `uint8[]` that `fill` writes at the end of the buffer.
    ///
    /// # Errors
    /// Those of `fill`.
    pub fn bytes_with<E>(&mut self, fill: impl FnOnce(&mut Vec<u8>) -> Result<(), E>) -> Result<usize, E> {
        self.u32(0);
        let start = self.buf.len();
        fill(self.buf)?;
        let len = self.buf.len() - start;
        self.buf[start - 4..start].copy_from_slice(&(len as u32).to_le_bytes());
        Ok(len)
    }

    /// Appends a `float64[N]`.
    pub fn f64s(&mut self, values: &[f64]) -> &mut Self {
        for v in values {
            self.f64(*v);
        }
        self
    }

    /// Appends a `uint64[N]`.
    pub fn u64s(&mut self, values: &[u64]) -> &mut Self {
        for v in values {
            self.u64(*v);
        }
        self
    }

    /// Appends a `builtin_interfaces/Time` of nanoseconds since 1970.
    pub fn time(&mut self, utc_ns: i64) -> &mut Self {
        self.i32(utc_ns.div_euclid(1_000_000_000) as i32);
        self.u32(utc_ns.rem_euclid(1_000_000_000) as u32)
    }

    /// Appends a `std_msgs/Header`.
    pub fn header(&mut self, utc_ns: i64, frame_id: &str) -> &mut Self {
        self.time(utc_ns).str(frame_id)
    }

    fn align(&mut self, size: usize) {
        let at = self.buf.len() - self.origin;
        self.buf.resize(self.origin + at.next_multiple_of(size), 0);
    }
}

/// Reads a CDR message; every length is checked against the bytes that are there.
pub struct Reader<'a> {
    data: &'a [u8],
    at: usize,
}

macro_rules! get {
    ($($name:ident: $t:ty),*) => {$(
        #[doc = concat!("Reads a `", stringify!($t), "`.")]
        ///
        /// # Errors
        /// [`ErrorKind::Corrupt`] when the message ends before.
        pub fn $name(&mut self) -> Result<$t> {
            self.at = self.at.next_multiple_of(size_of::<$t>());
            let mut bytes = [0; size_of::<$t>()];
            bytes.copy_from_slice(self.raw(size_of::<$t>())?);
            Ok(<$t>::from_le_bytes(bytes))
        }
    )*};
}

impl<'a> Reader<'a> {
    /// Begins to read `message`, encapsulation header included.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when it is not little-endian plain CDR.
    pub fn new(message: &'a [u8]) -> Result<Self> {
        match message.split_first_chunk::<4>() {
            Some((h, data)) if h[..2] == ENCAPSULATION[..2] => Ok(Self { data, at: 0 }),
            _ => Err(Error::new(ErrorKind::Corrupt, "a message is not little-endian CDR")),
        }
    }

    get!(u8: u8, u16: u16, u32: u32, u64: u64, i32: i32, i64: i64, f32: f32, f64: f64);

    /// Reads `n` bytes as they are.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when the message ends before.
    pub fn raw(&mut self, n: usize) -> Result<&'a [u8]> {
        let end = self.at.checked_add(n).filter(|end| *end <= self.data.len());
        let end = end.ok_or_else(|| {
            let at = self.at;
            let len = self.data.len();
            Error::new(
                ErrorKind::Corrupt,
                format!("a message of {len} bytes ends at byte {at} of its fields"),
            )
        })?;
        let bytes = &self.data[self.at..end];
        self.at = end;
        Ok(bytes)
    }

    /// Reads an `uint8[]`.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when the message ends before.
    pub fn bytes(&mut self) -> Result<&'a [u8]> {
        let n = self.u32()?;
        self.raw(n as usize)
    }

    /// Reads a string.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when the message ends before, or the text is not UTF-8.
    pub fn str(&mut self) -> Result<&'a str> {
        let bytes = self.bytes()?;
        let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        core::str::from_utf8(text)
            .map_err(|e| Error::new(ErrorKind::Corrupt, "a text in a message is not UTF-8").with_source(e))
    }

    /// Reads `N` values with `get`.
    ///
    /// # Errors
    /// Those of `get`.
    pub fn array<T: Copy + Default, const N: usize>(
        &mut self,
        mut get: impl FnMut(&mut Self) -> Result<T>,
    ) -> Result<[T; N]> {
        let mut values = [T::default(); N];
        for v in &mut values {
            *v = get(self)?;
        }
        Ok(values)
    }

    /// Reads a sequence: its length, then each element with `get`.
    ///
    /// # Errors
    /// Those of `get`, which end a sequence with a wrong length.
    pub fn seq<T>(&mut self, mut get: impl FnMut(&mut Self) -> Result<T>) -> Result<Vec<T>> {
        let n = self.u32()?;
        (0..n).map(|_| get(self)).collect()
    }

    /// Reads a `builtin_interfaces/Time` as nanoseconds since 1970.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when the message ends before.
    pub fn time(&mut self) -> Result<i64> {
        let sec = self.i32()?;
        Ok(i64::from(sec) * 1_000_000_000 + i64::from(self.u32()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bytes that `rmw_fastrtps` and Python's `mcap_ros2.writer` produce for these values.
    #[test]
    fn known_bytes() {
        let mut buf = vec![0xee]; // an odd start: alignment counts from the message, not from the buffer
        Writer::new(&mut buf)
            .time(1_500_000_002)
            .str("ab")
            .u8(7)
            .u16(0x0102)
            .f64(1.0)
            .u32(2)
            .raw(&[9, 8])
            .u64(3);
        #[rustfmt::skip]
        let expected: &[u8] = &[
            0xee, 0, 1, 0, 0,
            1, 0, 0, 0, 0x02, 0x65, 0xcd, 0x1d,    // 1 s, 500 000 002 ns
            3, 0, 0, 0, b'a', b'b', 0,             // length with NUL
            7, 2, 1,                               // at 15, at 16
            0, 0, 0, 0, 0, 0,                      // padding 18..24
            0, 0, 0, 0, 0, 0, 0xf0, 0x3f,
            2, 0, 0, 0, 9, 8,
            0, 0,                                  // padding 38..40
            3, 0, 0, 0, 0, 0, 0, 0,
        ];
        assert_eq!(buf, expected);
        let mut r = Reader::new(&buf[1..]).unwrap();
        assert_eq!(r.time().unwrap(), 1_500_000_002);
        assert_eq!(r.str().unwrap(), "ab");
        assert_eq!((r.u8().unwrap(), r.u16().unwrap(), r.f64().unwrap()), (7, 0x0102, 1.0));
        assert_eq!((r.bytes().unwrap(), r.u64().unwrap()), (&[9u8, 8][..], 3));
        assert_eq!(r.u8().unwrap_err().kind(), ErrorKind::Corrupt);
    }

    #[test]
    fn times_before_1970_keep_positive_nanoseconds() {
        let mut buf = Vec::new();
        Writer::new(&mut buf).time(-1);
        assert_eq!(buf[4..8], (-1i32).to_le_bytes());
        assert_eq!(Reader::new(&buf).unwrap().time().unwrap(), -1);
    }

    #[test]
    fn a_lying_length_is_an_error_and_allocates_nothing() {
        let mut buf = Vec::new();
        Writer::new(&mut buf).u32(u32::MAX);
        assert!(Reader::new(&buf).unwrap().bytes().is_err());
        assert!(Reader::new(&buf).unwrap().seq(Reader::u64).is_err());
        assert!(Reader::new(&[0, 0, 0, 0]).is_err(), "big-endian is refused");
    }
}
