//! One array from or to a `.npy` file, with messages a NumPy user understands.

use std::{
    fs::File,
    io::{self, Read, Write},
    path::Path,
};

use ndarray::ArrayD;
use ndarray_npy::{ReadNpyExt, WriteNpyError, WriteNpyExt, npy::header::Header};

use crate::{HandoffError, kind::Dtype};

/// Longest header that is parsed, bytes. NumPy writes 118 for a plain array; a longer header
/// is a structured dtype or not a header at all.
const MAX_HEADER_BYTES: usize = 1024;

/// Magic string, version and length field before the header take 12 bytes at most.
const MAX_PREFIX_BYTES: u64 = 12 + MAX_HEADER_BYTES as u64;

/// An array of one of the three element types, in C order.
#[derive(Clone, Debug, PartialEq)]
pub enum ArrayData {
    /// `<f8`.
    F64(ArrayD<f64>),
    /// `<i8`.
    I64(ArrayD<i64>),
    /// `|u1`.
    U8(ArrayD<u8>),
}

impl ArrayData {
    /// Sizes along the axes.
    pub fn shape(&self) -> &[usize] {
        match self {
            Self::F64(a) => a.shape(),
            Self::I64(a) => a.shape(),
            Self::U8(a) => a.shape(),
        }
    }

    /// Element type.
    pub fn dtype(&self) -> Dtype {
        match self {
            Self::F64(_) => Dtype::F64,
            Self::I64(_) => Dtype::I64,
            Self::U8(_) => Dtype::U8,
        }
    }

    /// The bytes of a `.npy` file.
    pub fn to_npy(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        self.write_npy(&mut bytes).expect("writing to memory cannot fail");
        bytes
    }

    fn write_npy(&self, writer: impl Write) -> io::Result<()> {
        match self {
            Self::F64(a) => a.write_npy(writer),
            Self::I64(a) => a.write_npy(writer),
            Self::U8(a) => a.write_npy(writer),
        }
        .map_err(|e| match e {
            WriteNpyError::Io(e) => e,
            other => io::Error::other(other),
        })
    }
}

/// A file and the BLAKE3 of what has been read from it or written to it: a large array is in memory
/// once.
struct Hashed<F> {
    file: F,
    hasher: blake3::Hasher,
}

/// Bytes that are hashed while they are in the cache.
const CHUNK_BYTES: usize = 1 << 18;

impl<F> Hashed<F> {
    fn new(file: F) -> Self {
        Self { file, hasher: blake3::Hasher::new() }
    }

    fn finish(self) -> String {
        self.hasher.finalize().to_string()
    }
}

impl<F: Read> Read for Hashed<F> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let end = buffer.len().min(CHUNK_BYTES);
        let count = self.file.read(&mut buffer[..end])?;
        self.hasher.update(&buffer[..count]);
        Ok(count)
    }
}

impl<F: Write> Write for Hashed<F> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.file.write(&bytes[..bytes.len().min(CHUNK_BYTES)])?;
        self.hasher.update(&bytes[..count]);
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Writes `array` as the new file `path`; returns its BLAKE3.
pub(crate) fn write(path: &Path, array: &ArrayData) -> Result<String, HandoffError> {
    let mut file = None;
    File::create_new(path)
        .and_then(|new| array.write_npy(file.insert(Hashed::new(new))))
        .map_err(|e| HandoffError::io(path, "write", &e))?;
    Ok(file.expect("it was written").finish())
}

/// The BLAKE3 of the file `path`.
pub(crate) fn hash(path: &Path) -> io::Result<String> {
    let mut file = Hashed::new(File::open(path)?);
    io::copy(&mut file, &mut io::sink())?;
    Ok(file.finish())
}

/// Reads `path` as an array of `dtype`; returns it with the BLAKE3 of the file.
///
/// Nothing is allocated beyond the size of the file, whatever its header says.
pub fn read(path: &Path, dtype: Dtype) -> Result<(ArrayData, String), HandoffError> {
    let io = |e: io::Error| HandoffError::io(path, "read", &e);
    let invalid = |problem: String| HandoffError::new(path, problem);
    if !path.metadata().map_err(io)?.is_file() {
        return Err(invalid("is not a file; give a .npy file".into()));
    }
    let file = File::open(path).map_err(io)?;
    let file_bytes = file.metadata().map_err(io)?.len();
    // The header decides before the rest is read: a file may claim any size.
    let mut prefix = Vec::new();
    (&file).take(MAX_PREFIX_BYTES).read_to_end(&mut prefix).map_err(io)?;
    let elements = check(&prefix, file_bytes, dtype).map_err(invalid)?;
    let mut whole = Hashed::new(prefix.chain(file));
    let array = array(&mut whole, dtype, elements).map_err(invalid)?;
    Ok((array, whole.finish()))
}

/// The array in the bytes of a `.npy` file, or what is wrong with them.
pub fn parse(bytes: &[u8], dtype: Dtype) -> Result<ArrayData, String> {
    let elements = check(bytes, bytes.len() as u64, dtype)?;
    array(bytes, dtype, elements)
}

/// The array in a file that has been checked.
fn array(reader: impl Read, dtype: Dtype, elements: Elements) -> Result<ArrayData, String> {
    let broken = |e: ndarray_npy::ReadNpyError| format!("cannot be read ({e}); write it again");
    match dtype {
        Dtype::F64 => ArrayD::read_npy(reader).map(standard).map(ArrayData::F64),
        Dtype::I64 => ArrayD::read_npy(reader).map(standard).map(ArrayData::I64),
        Dtype::U8 if elements == Elements::Bool => {
            ArrayD::<bool>::read_npy(reader).map(|a| ArrayData::U8(standard(a.mapv(u8::from))))
        }
        Dtype::U8 => ArrayD::read_npy(reader).map(standard).map(ArrayData::U8),
    }
    .map_err(broken)
}

/// Elements in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Elements {
    /// Those of the wanted element type.
    Wanted,
    /// NumPy's booleans where bytes are wanted.
    Bool,
}

/// Whether a file of `file_bytes` that starts with `bytes` (its whole header at least) holds
/// exactly one array of `dtype`.
fn check(bytes: &[u8], file_bytes: u64, dtype: Dtype) -> Result<Elements, String> {
    let header_end = header_end(bytes)?;
    let header = Header::from_reader(&mut &bytes[..header_end])
        .map_err(|e| format!("has a broken .npy header ({e}); write it with numpy.save"))?;

    let descriptor = match header.type_descriptor.as_string() {
        Some(d) => d.as_str(),
        None => {
            return Err(format!("holds structured records; save a plain {} array", dtype.numpy()));
        }
    };
    let bool_as_u8 = dtype == Dtype::U8 && descriptor == "|b1";
    if descriptor != dtype.numpy() && !bool_as_u8 {
        return Err(wrong_dtype(descriptor, dtype));
    }
    let shape = &header.shape;
    let flat = shape.iter().filter(|n| **n > 1).count() <= 1;
    if header.layout.is_fortran() && !flat {
        return Err("is in Fortran order; save numpy.ascontiguousarray(a)".into());
    }
    if shape.is_empty() {
        return Err("holds a scalar; save an array".into());
    }
    if shape.contains(&0) {
        return Err(format!("is empty (shape {shape:?}); save at least one element"));
    }
    let item: u64 = if dtype == Dtype::U8 { 1 } else { 8 };
    let expected = shape.iter().try_fold(item, |n, s| n.checked_mul(*s as u64));
    let found = file_bytes.saturating_sub(header_end as u64);
    match expected {
        None => Err(format!("claims the impossible shape {shape:?}; write it again")),
        Some(n) if n > found => Err(format!(
            "is truncated: shape {shape:?} needs {n} bytes, the file has {found}; write it again"
        )),
        Some(n) if n < found => Err(format!(
            "has {} bytes after the array of shape {shape:?}; write it again",
            found - n
        )),
        Some(_) if bool_as_u8 => Ok(Elements::Bool),
        Some(_) => Ok(Elements::Wanted),
    }
}

/// C order in memory; differs from the file's only where at most one axis is longer than 1.
fn standard<T: Clone>(array: ArrayD<T>) -> ArrayD<T> {
    if array.is_standard_layout() { array } else { array.as_standard_layout().into_owned() }
}

/// Where the header ends, checked before anything is parsed: the parser's time grows
/// exponentially with nested brackets, and it allocates what the length field says.
fn header_end(bytes: &[u8]) -> Result<usize, String> {
    const MAGIC: &[u8] = b"\x93NUMPY";
    if !bytes.starts_with(MAGIC) {
        return Err("is not a .npy file; write it with numpy.save".into());
    }
    let truncated = || String::from("is truncated within its header; write it again");
    let version = *bytes.get(6).ok_or_else(truncated)?;
    let length_bytes = if version == 1 { 2 } else { 4 };
    let field = bytes.get(8..8 + length_bytes).ok_or_else(truncated)?;
    let length = field.iter().rev().fold(0usize, |n, b| (n << 8) | usize::from(*b));
    if length > MAX_HEADER_BYTES {
        return Err(format!(
            "has a header of {length} bytes (at most {MAX_HEADER_BYTES}); save a plain array"
        ));
    }
    let end = 8 + length_bytes + length;
    if bytes.len() < end {
        return Err(truncated());
    }
    // A plain array has the bracket of the dictionary and that of the shape.
    if bytes[8..end].iter().filter(|b| b"([{".contains(b)).count() > 2 {
        return Err("holds structured records or has a broken header; save a plain array".into());
    }
    Ok(end)
}

fn wrong_dtype(found: &str, wanted: Dtype) -> String {
    let numpy = wanted.numpy();
    let big_endian = found.starts_with('>');
    let what = if big_endian { "big-endian elements" } else { "elements" };
    format!("has {what} of dtype {found}, needs {numpy}; save a.astype('{numpy}')")
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;
    use proptest::prelude::*;

    /// A `.npy` file of version 1 with this header dictionary and data.
    fn file(dictionary: &str, data: &[u8]) -> Vec<u8> {
        let mut header = dictionary.to_string();
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    fn error(dictionary: &str, data: &[u8]) -> String {
        parse(&file(dictionary, data), Dtype::F64).unwrap_err()
    }

    #[test]
    fn round_trip_keeps_every_bit() {
        let a = ArrayData::F64(
            array![[1.0, f64::NAN, -0.0], [f64::MIN_POSITIVE, 1e308, 0.1]].into_dyn(),
        );
        let bytes = a.to_npy();
        assert_eq!(parse(&bytes, Dtype::F64).unwrap().to_npy(), bytes);
        let a = ArrayData::I64(array![i64::MIN, -1, i64::MAX].into_dyn());
        assert_eq!(parse(&a.to_npy(), Dtype::I64).unwrap(), a);
        let a = ArrayData::U8(array![0, 1, 255].into_dyn());
        assert_eq!(parse(&a.to_npy(), Dtype::U8).unwrap(), a);
    }

    #[test]
    fn numpy_booleans_are_read_as_bytes() {
        let bytes = file("{'descr': '|b1', 'fortran_order': False, 'shape': (2,), }", &[1, 0]);
        assert_eq!(parse(&bytes, Dtype::U8).unwrap(), ArrayData::U8(array![1, 0].into_dyn()));
    }

    #[test]
    fn bad_files_get_one_clear_message() {
        let data = [0; 16];
        for (dictionary, expected) in [
            ("{'descr': '<f4', 'fortran_order': False, 'shape': (4,), }", "astype('<f8')"),
            ("{'descr': '<i8', 'fortran_order': False, 'shape': (2,), }", "dtype <i8, needs <f8"),
            ("{'descr': '>f8', 'fortran_order': False, 'shape': (2,), }", "big-endian"),
            ("{'descr': '|O', 'fortran_order': False, 'shape': (2,), }", "dtype |O"),
            ("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (2,), }", "records"),
            ("{'descr': '<f8', 'fortran_order': True, 'shape': (2, 2), }", "ascontiguousarray"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (3,), }", "truncated"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }", "8 bytes after"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (0,), }", "empty"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (), }", "scalar"),
            (
                "{'descr': '<f8', 'fortran_order': False, 'shape': (9223372036854775807, 2), }",
                "impossible",
            ),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }", "truncated"),
            (
                "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999999999,), }",
                "header",
            ),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (-2,), }", "header"),
            ("{'descr': '<f8', 'shape': (2,), }", "header"),
            ("nonsense", "header"),
        ] {
            let message = error(dictionary, &data);
            assert!(message.contains(expected), "{dictionary}: {message}");
        }
        assert!(parse(b"", Dtype::F64).unwrap_err().contains("not a .npy"));
        assert!(parse(b"\x93NUMPY\x01\x00\xff\xff", Dtype::F64).unwrap_err().contains("header"));
        assert!(error(&"(".repeat(2000), &data).contains("header of 2001 bytes"));
        assert!(error(&"(".repeat(1000), &data).contains("broken header"));
        assert!(
            error(&format!("{}{}", "[".repeat(500), "]".repeat(500)), &data).contains("broken")
        );
    }

    proptest! {
        /// Any damage to a valid file gives an array or a message, never a panic.
        #[test]
        fn damaged_files_never_panic(
            cut in 0..=192_usize, damage in prop::collection::vec((0..192_usize, any::<u8>()), 0..4),
        ) {
            let mut bytes = ArrayData::F64(ArrayD::zeros(vec![2, 4])).to_npy();
            prop_assert_eq!(bytes.len(), 192);
            for (at, value) in damage {
                bytes[at] = value;
            }
            for dtype in [Dtype::F64, Dtype::I64, Dtype::U8] {
                let _ = parse(&bytes[..cut], dtype);
            }
        }
    }
}
