//! Numbers and text read from the bytes of a file, with messages if the bytes end too early.

use planish_types::Invalid;

/// The bytes of a file, read by their offset from its beginning.
#[derive(Clone, Copy)]
pub(crate) struct Bytes<'a> {
    pub all: &'a [u8],
    /// Subject of the messages, for example "FITS file".
    pub name: &'static str,
    pub big_endian: bool,
}

impl<'a> Bytes<'a> {
    /// Returns `len` bytes from byte `start` on. Refuses a range beyond the end of the file.
    pub fn slice(&self, start: usize, len: usize) -> Result<&'a [u8], Invalid> {
        start.checked_add(len).and_then(|end| self.all.get(start..end)).ok_or_else(|| {
            let problem =
                format!("is truncated: {len} bytes at byte {start}, {} are there", self.all.len());
            Invalid::whole(self.name, problem, "export it again")
        })
    }

    /// Returns the N bytes of a number from byte `start` on, in the byte order of this machine. Refuses a range beyond
    /// the end of the file.
    fn array<const N: usize>(&self, start: usize) -> Result<[u8; N], Invalid> {
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.slice(start, N)?);
        if self.big_endian != cfg!(target_endian = "big") {
            bytes.reverse();
        }
        Ok(bytes)
    }

    pub fn u16(&self, start: usize) -> Result<u16, Invalid> {
        self.array(start).map(u16::from_ne_bytes)
    }

    pub fn i16(&self, start: usize) -> Result<i16, Invalid> {
        self.array(start).map(i16::from_ne_bytes)
    }

    pub fn u32(&self, start: usize) -> Result<u32, Invalid> {
        self.array(start).map(u32::from_ne_bytes)
    }

    pub fn i32(&self, start: usize) -> Result<i32, Invalid> {
        self.array(start).map(i32::from_ne_bytes)
    }

    pub fn f32(&self, start: usize) -> Result<f32, Invalid> {
        self.array(start).map(f32::from_ne_bytes)
    }

    pub fn f64(&self, start: usize) -> Result<f64, Invalid> {
        self.array(start).map(f64::from_ne_bytes)
    }

    /// Returns the text in `len` bytes from byte `start` on, up to a NUL. Control characters, and blanks at the ends,
    /// are removed. Refuses a range beyond the end of the file.
    pub fn text(&self, start: usize, len: usize) -> Result<String, Invalid> {
        let bytes = self.slice(start, len)?;
        let end = bytes.iter().position(|b| *b == 0).unwrap_or(len);
        let text = String::from_utf8_lossy(&bytes[..end]);
        Ok(text.chars().filter(|c| !c.is_control()).collect::<String>().trim().to_string())
    }
}

/// A type of number that a file stores: integer, unsigned integer or float, with its bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F16,
    F32,
    F64,
}

impl Number {
    /// Returns the size of one number, bytes.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 | Self::F16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// Returns the first `count` numbers of `bytes`, or fewer if `bytes` is shorter. `big_endian` is true if the most
    /// significant byte comes first. Refuses a 64-bit integer that no 64-bit float equals.
    pub fn decode(self, bytes: &[u8], count: usize, big_endian: bool) -> Result<Vec<f64>, Invalid> {
        fn each<const N: usize>(
            bytes: &[u8],
            count: usize,
            big_endian: bool,
            value: impl Fn([u8; N]) -> f64,
        ) -> Vec<f64> {
            let swap = big_endian != cfg!(target_endian = "big");
            let chunks = bytes.chunks_exact(N).take(count);
            chunks
                .map(|c| {
                    let mut a = [0; N];
                    a.copy_from_slice(c);
                    if swap {
                        a.reverse();
                    }
                    value(a)
                })
                .collect()
        }
        let values = match self {
            Self::I8 => each(bytes, count, big_endian, |a| f64::from(i8::from_ne_bytes(a))),
            Self::U8 => each(bytes, count, big_endian, |a| f64::from(u8::from_ne_bytes(a))),
            Self::I16 => each(bytes, count, big_endian, |a| f64::from(i16::from_ne_bytes(a))),
            Self::U16 => each(bytes, count, big_endian, |a| f64::from(u16::from_ne_bytes(a))),
            Self::I32 => each(bytes, count, big_endian, |a| f64::from(i32::from_ne_bytes(a))),
            Self::U32 => each(bytes, count, big_endian, |a| f64::from(u32::from_ne_bytes(a))),
            Self::I64 => each(bytes, count, big_endian, |a| exact(i64::from_ne_bytes(a))),
            Self::U64 => each(bytes, count, big_endian, |a| exact(u64::from_ne_bytes(a))),
            Self::F16 => each(bytes, count, big_endian, |a| half(u16::from_ne_bytes(a))),
            Self::F32 => each(bytes, count, big_endian, |a| f64::from(f32::from_ne_bytes(a))),
            Self::F64 => each(bytes, count, big_endian, f64::from_ne_bytes),
        };
        if matches!(self, Self::I64 | Self::U64) {
            refuse_rounded(&values)?;
        }
        Ok(values)
    }
}

/// Returns the value of a 16-bit float (IEEE 754 binary16) from its bits.
fn half(bits: u16) -> f64 {
    let exponent = i32::from(bits >> 10) & 31;
    let fraction = f64::from(bits & 1023);
    let magnitude = match exponent {
        0 => fraction * 2f64.powi(-24),
        31 if fraction == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        _ => (1024.0 + fraction) * 2f64.powi(exponent - 25),
    };
    if bits >> 15 == 1 { -magnitude } else { magnitude }
}

/// Returns a 64-bit integer as a float, or infinity if no float is equal to it.
pub(crate) fn exact<T: Copy + Into<i128>>(v: T) -> f64 {
    let v: i128 = v.into();
    let float = v as f64;
    if float as i128 == v { float } else { f64::INFINITY }
}

/// Refuses numbers that [`exact`] could not convert, by the index of the first one: those that are infinite.
pub(crate) fn refuse_rounded<'a>(values: impl IntoIterator<Item = &'a f64>) -> Result<(), Invalid> {
    match values.into_iter().position(|v| v.is_infinite()) {
        None => Ok(()),
        Some(i) => {
            let problem = "is a 64-bit integer beyond 2^53 that no 64-bit float is equal to";
            let remedy = "subtract the mean, or save it as floats";
            Err(Invalid::at_index("stored value", i, problem, remedy))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_by_hand() {
        // Sign, exponent, fraction: 1.5; -2; 65504, the largest; 2^-24, the smallest; 2^-14, the smallest normal one.
        let cases = [
            (0x3E00, 1.5),
            (0xC000, -2.0),
            (0x7BFF, 65504.0),
            (1, 2f64.powi(-24)),
            (0x0400, 2f64.powi(-14)),
            (0x7C00, f64::INFINITY),
        ];
        for (bits, value) in cases {
            assert_eq!(half(bits), value);
        }
        assert!(half(0x7E00).is_nan());
        assert_eq!(Number::F16.decode(&[0x3E, 0, 0xC0, 0], 2, true).unwrap(), [1.5, -2.0]);
    }
}
