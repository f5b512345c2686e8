//! Reads and writes one array as a `.npy` file, with messages that a NumPy user understands.

use std::{
    fs::File,
    io::{self, Read, Write},
    path::Path,
};

use ndarray::{ArrayD, CowArray, IxDyn, ShapeBuilder};
use ndarray_npy::{ReadNpyExt, WriteNpyError, WriteNpyExt, npy::header::Header};
use planish_types::budget;

use crate::{HandoffError, kind::Dtype};

/// Longest header that is parsed, bytes. Larger: a damaged length takes more time and memory.
/// Smaller: plain arrays could be refused; NumPy writes 118 bytes for one. A longer header is a
/// structured dtype or no header at all.
const MAX_HEADER_BYTES: usize = 1024;

/// Bytes at the beginning of a file that contain its header. Derived: magic string, version and
/// length field before the header take 12 bytes at most.
const MAX_PREFIX_BYTES: u64 = 12 + MAX_HEADER_BYTES as u64;

/// An array of one of the three element types, in C order. An array to be written is borrowed, not
/// copied.
#[derive(Clone, Debug, PartialEq)]
pub enum ArrayData<'a> {
    /// 64-bit floats, `<f8`.
    F64(CowArray<'a, f64, IxDyn>),
    /// 64-bit signed integers, `<i8`.
    I64(CowArray<'a, i64, IxDyn>),
    /// Unsigned bytes, `|u1`.
    U8(CowArray<'a, u8, IxDyn>),
}

impl ArrayData<'_> {
    /// Returns the sizes along the axes.
    pub fn shape(&self) -> &[usize] {
        match self {
            Self::F64(a) => a.shape(),
            Self::I64(a) => a.shape(),
            Self::U8(a) => a.shape(),
        }
    }

    /// Returns the element type.
    pub fn dtype(&self) -> Dtype {
        match self {
            Self::F64(_) => Dtype::F64,
            Self::I64(_) => Dtype::I64,
            Self::U8(_) => Dtype::U8,
        }
    }

    /// Returns the content of a `.npy` file with this array.
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

/// A file together with the BLAKE3 hash of the bytes read from it or written to it. Hashing on the way needs no
/// second copy of a large array.
struct Hashed<F> {
    file: F,
    hasher: blake3::Hasher,
}

/// Number of bytes that are hashed at a time. Larger: they leave the cache before they are hashed.
/// Smaller: more calls. It does not change the hash.
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

/// Writes `array` as the new file `path` and returns the BLAKE3 hash of the file. The file is on the disk when the
/// function returns.
pub(crate) fn write(path: &Path, array: &ArrayData) -> Result<String, HandoffError> {
    let mut file = None;
    File::create_new(path)
        .and_then(|new| {
            let file = file.insert(Hashed::new(new));
            array.write_npy(&mut *file).and_then(|()| file.file.sync_data())
        })
        .map_err(|e| HandoffError::io(path, "write", &e))?;
    Ok(file.expect("it was written").finish())
}

/// Returns the BLAKE3 of the regular file `path`. Pipes and devices are refused, because they may never end.
pub(crate) fn hash(path: &Path) -> io::Result<String> {
    if !path.metadata()?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "is not a file"));
    }
    let mut file = Hashed::new(File::open(path)?);
    io::copy(&mut file, &mut io::sink())?;
    Ok(file.finish())
}

/// An array that has been read from a file, with the hash of the file.
#[derive(Clone, Debug, PartialEq)]
pub struct Loaded {
    /// The array, in C order.
    pub array: ArrayData<'static>,
    /// BLAKE3 hash of the file.
    pub blake3: String,
    /// Note about an exact conversion, such as "holds >f4 in Fortran order, converted exactly". It is `None` if nothing
    /// was converted, and for booleans that are read as 0 and 1.
    pub note: Option<String>,
}

/// Reads `path` as an array of `dtype`. Other element types, byte orders and Fortran order are converted if no value
/// changes, and refused otherwise. It also refuses scalars, empty arrays, and files that are shorter or longer than
/// their header says. NaN and infinity are read.
///
/// The memory that it allocates is limited by the size of the file, whatever the header says.
pub fn read(path: &Path, dtype: Dtype) -> Result<Loaded, HandoffError> {
    let io = |e: io::Error| HandoffError::io(path, "read", &e);
    let invalid = |problem: String| HandoffError::new(path, problem);
    if !path.metadata().map_err(io)?.is_file() {
        return Err(invalid("is not a file; give a .npy file".into()));
    }
    let file = File::open(path).map_err(io)?;
    let file_bytes = file.metadata().map_err(io)?.len();
    // The header is checked before the rest is read, because a file may claim any size.
    let mut prefix = Vec::new();
    (&file).take(MAX_PREFIX_BYTES).read_to_end(&mut prefix).map_err(io)?;
    let stored = check(&prefix, file_bytes, dtype).map_err(invalid)?;
    let mut whole = Hashed::new(prefix.chain(file));
    let array = array(&mut whole, dtype, &stored).map_err(invalid)?;
    Ok(Loaded { array, blake3: whole.finish(), note: stored.note(dtype) })
}

/// Parses the content of a `.npy` file as an array of `dtype`.
///
/// # Errors
/// Returns the message about the fault of bytes that are no array of this type.
pub fn parse(bytes: &[u8], dtype: Dtype) -> Result<ArrayData<'static>, String> {
    let stored = check(bytes, bytes.len() as u64, dtype)?;
    array(bytes, dtype, &stored)
}

/// Reads the array of a file whose header has been checked.
fn array(
    mut reader: impl Read,
    dtype: Dtype,
    stored: &Stored,
) -> Result<ArrayData<'static>, String> {
    let broken = |e: &dyn std::fmt::Display| format!("cannot be read ({e}); write it again");
    if stored.is_as_wanted(dtype) {
        return match dtype {
            Dtype::F64 => ArrayD::read_npy(reader).map(standard).map(|a| ArrayData::F64(a.into())),
            Dtype::I64 => ArrayD::read_npy(reader).map(standard).map(|a| ArrayData::I64(a.into())),
            Dtype::U8 => ArrayD::read_npy(reader).map(standard).map(|a| ArrayData::U8(a.into())),
        }
        .map_err(|e| broken(&e));
    }
    let mut bytes = Vec::new();
    reader.read_to_end(&mut bytes).map_err(|e| broken(&e))?;
    let items = bytes[stored.header_bytes..].chunks_exact(stored.element.bytes);
    let values = items.map(|item| stored.element.value(item));
    Ok(match dtype {
        Dtype::F64 => ArrayData::F64(stored.converted(values, Value::to_f64, dtype)?.into()),
        Dtype::I64 => ArrayData::I64(stored.converted(values, Value::to_i64, dtype)?.into()),
        Dtype::U8 => ArrayData::U8(stored.converted(values, Value::to_u8, dtype)?.into()),
    })
}

/// Content of the header of a `.npy` file.
#[derive(Debug)]
struct Stored {
    descriptor: String,
    element: Element,
    is_fortran: bool,
    shape: Vec<usize>,
    header_bytes: usize,
}

impl Stored {
    /// Returns true if the elements need no conversion to be read as `dtype` in C order.
    fn is_as_wanted(&self, dtype: Dtype) -> bool {
        self.descriptor == dtype.numpy() && (!self.is_fortran || self.is_flat())
    }

    /// Returns true if at most one axis is longer than 1, so that C and Fortran order are the same.
    fn is_flat(&self) -> bool {
        self.shape.iter().filter(|n| **n > 1).count() <= 1
    }

    /// Returns a note for the user about the conversion to `dtype`; `None` if none was needed. Booleans read as 0 and
    /// 1 need no note.
    fn note(&self, dtype: Dtype) -> Option<String> {
        let as_flags = dtype == Dtype::U8 && self.element.class == Class::Bool;
        let reordered = self.is_fortran && !self.is_flat();
        if self.is_as_wanted(dtype) || (as_flags && !reordered) {
            return None;
        }
        let order = if reordered { " in Fortran order" } else { "" };
        Some(format!("holds {}{order}, converted exactly", self.descriptor))
    }

    /// Returns the array of `values` in C order, each converted by `exact`, which returns `None` if the value would
    /// change. The error names the first such value.
    fn converted<T: Clone>(
        &self,
        values: impl Iterator<Item = Value>,
        exact: impl Fn(Value) -> Option<T>,
        dtype: Dtype,
    ) -> Result<ArrayD<T>, String> {
        let numpy = dtype.numpy();
        let each = values.enumerate().map(|(number, value)| {
            exact(value).ok_or_else(|| {
                let index = self.index(number);
                format!(
                    "element {index:?} is {value} of dtype {}, which {numpy} does not have; save \
                     a.astype('{numpy}') if the loss is meant",
                    self.descriptor
                )
            })
        });
        let elements = each.collect::<Result<Vec<T>, String>>()?;
        let shape = self.shape.clone().set_f(self.is_fortran);
        let array = ArrayD::from_shape_vec(shape, elements).map_err(|e| e.to_string())?;
        Ok(standard(array))
    }

    /// Returns the index along each axis of the element `number`, counted from 0 in the order of the file.
    fn index(&self, number: usize) -> Vec<usize> {
        let mut fastest_first: Vec<usize> = (0..self.shape.len()).collect();
        if !self.is_fortran {
            fastest_first.reverse();
        }
        let mut index = vec![0; self.shape.len()];
        let mut rest = number;
        for axis in fastest_first {
            index[axis] = rest % self.shape[axis];
            rest /= self.shape[axis];
        }
        index
    }
}

/// NumPy element type that can be read as a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Element {
    class: Class,
    bytes: usize,
    big_endian: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Class {
    Bool,
    Signed,
    Unsigned,
    Float,
}

/// Value of one element, large enough for every type of a file.
#[derive(Clone, Copy, Debug)]
enum Value {
    Integer(i128),
    Float(f64),
}

impl Element {
    /// Parses NumPy's name of an element type, such as `<f8`: byte order, class, bytes. `None` for a type that is not
    /// supported.
    fn parse(descriptor: &str) -> Option<Self> {
        let (order, rest) = descriptor.split_at_checked(1)?;
        let (class, bytes) = rest.split_at_checked(1)?;
        let bytes: usize = bytes.parse().ok()?;
        let class = match (class, bytes) {
            ("b", 1) => Class::Bool,
            ("i", 1 | 2 | 4 | 8) => Class::Signed,
            ("u", 1 | 2 | 4 | 8) => Class::Unsigned,
            ("f", 4 | 8) => Class::Float,
            _ => return None,
        };
        if !matches!(order, "<" | ">" | "|") {
            return None;
        }
        Some(Self { class, bytes, big_endian: order == ">" })
    }

    /// Returns the value that the bytes `item` of one element stand for.
    fn value(self, item: &[u8]) -> Value {
        let mut raw = [0; 8];
        raw[..item.len()].copy_from_slice(item);
        if self.big_endian {
            raw[..item.len()].reverse();
        }
        let bits = u64::from_le_bytes(raw);
        // Up to the top of 64 bits and back keeps the sign.
        let unused = 64 - 8 * self.bytes as u32;
        match self.class {
            Class::Float if self.bytes == 4 => Value::Float(f64::from(f32::from_bits(bits as u32))),
            Class::Float => Value::Float(f64::from_bits(bits)),
            Class::Signed => Value::Integer(i128::from((bits << unused) as i64 >> unused)),
            Class::Unsigned | Class::Bool => Value::Integer(i128::from(bits)),
        }
    }
}

impl Value {
    fn to_f64(self) -> Option<f64> {
        match self {
            Self::Float(v) => Some(v),
            Self::Integer(v) => {
                let float = v as f64;
                if float as i128 == v { Some(float) } else { None }
            }
        }
    }

    fn to_i64(self) -> Option<i64> {
        match self {
            Self::Integer(v) => i64::try_from(v).ok(),
            // Every float below 2^63 in magnitude that is whole is an integer of 64 bits.
            Self::Float(v) if v.fract() == 0.0 && v.abs() < 2f64.powi(63) => Some(v as i64),
            Self::Float(_) => None,
        }
    }

    fn to_u8(self) -> Option<u8> {
        self.to_i64().and_then(|v| u8::try_from(v).ok())
    }
}

impl std::fmt::Display for Value {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Integer(v) => v.fmt(f),
            Self::Float(v) => v.fmt(f),
        }
    }
}

/// Checks that a file of `file_bytes` bytes holds exactly one array with elements, that its element type can be read as
/// `dtype`, and that it fits into the memory budget. `bytes` is the beginning of the file with the whole header.
fn check(bytes: &[u8], file_bytes: u64, dtype: Dtype) -> Result<Stored, String> {
    if file_bytes == 0 {
        return Err("is empty (0 bytes); write it with numpy.save".into());
    }
    let header_bytes = header_end(bytes)?;
    let header = Header::from_reader(&mut &bytes[..header_bytes])
        .map_err(|e| format!("has a broken .npy header ({e}); write it with numpy.save"))?;

    let numpy = dtype.numpy();
    let descriptor = match header.type_descriptor.as_string() {
        Some(d) => d.clone(),
        None => return Err(format!("holds structured records; save a plain {numpy} array")),
    };
    let Some(element) = Element::parse(&descriptor) else {
        let kind = descriptor.trim_start_matches(['<', '>', '=', '|']).chars().next();
        return Err(match kind {
            Some('c') => format!("is complex ({descriptor}), needs {numpy}; save a.real"),
            _ => format!(
                "has elements of dtype {descriptor}, needs {numpy}; save a.astype('{numpy}')"
            ),
        });
    };
    let shape = header.shape;
    if shape.is_empty() {
        return Err("holds a scalar; save an array".into());
    }
    if shape.contains(&0) {
        return Err(format!("is empty (shape {shape:?}); save at least one element"));
    }
    let count = shape.iter().try_fold(1u64, |n, s| n.checked_mul(*s as u64));
    let expected = count.and_then(|n| n.checked_mul(element.bytes as u64));
    let stored_bytes = file_bytes.saturating_sub(header_bytes as u64);
    match expected {
        None => return Err(format!("claims the impossible shape {shape:?}; write it again")),
        Some(n) if n > stored_bytes => {
            return Err(format!(
                "is truncated: shape {shape:?} needs {n} bytes, the file has {stored_bytes}; write it again"
            ));
        }
        Some(n) if n < stored_bytes => {
            return Err(format!(
                "has {} bytes after the array of shape {shape:?}; write it again",
                stored_bytes - n
            ));
        }
        Some(_) => {}
    }
    let is_fortran = header.layout.is_fortran();
    let stored = Stored { descriptor, element, is_fortran, shape, header_bytes };
    // A conversion needs memory for the file beside the array.
    let conversion = if stored.is_as_wanted(dtype) { 0 } else { element.bytes };
    let elements = count.unwrap_or(u64::MAX) as f64;
    budget::affordable("array", elements, dtype.bytes() + conversion, "give a smaller array")
        .map_err(|e| format!("{}; {}", e.problem, e.remedy))?;
    Ok(stored)
}

/// Returns the array in C order, copied only if its order differs.
fn standard<T: Clone>(array: ArrayD<T>) -> ArrayD<T> {
    if array.is_standard_layout() { array } else { array.as_standard_layout().into_owned() }
}

/// Returns the number of bytes from the beginning of the file to the end of the header. It limits the header before
/// anything is parsed. The time of the parser grows exponentially with nested brackets, and it allocates as much as
/// the length field says.
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
    // A plain array has two opening brackets: that of the dictionary and that of the shape.
    if bytes[8..end].iter().filter(|b| b"([{".contains(b)).count() > 2 {
        return Err("holds structured records or has a broken header; save a plain array".into());
    }
    Ok(end)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;
    use proptest::prelude::*;

    #[test]
    #[cfg(unix)]
    fn what_is_no_file_has_no_hash() {
        // Reading it would never end.
        assert!(hash(Path::new("/dev/zero")).is_err());
        assert!(hash(Path::new("/")).is_err());
    }

    /// Returns a `.npy` file of version 1 with the header `dictionary` and the elements `data`.
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
            array![[1.0, f64::NAN, -0.0], [f64::MIN_POSITIVE, 1e308, 0.1]].into_dyn().into(),
        );
        let bytes = a.to_npy();
        assert_eq!(parse(&bytes, Dtype::F64).unwrap().to_npy(), bytes);
        let a = ArrayData::I64(array![i64::MIN, -1, i64::MAX].into_dyn().into());
        assert_eq!(parse(&a.to_npy(), Dtype::I64).unwrap(), a);
        let a = ArrayData::U8(array![0, 1, 255].into_dyn().into());
        assert_eq!(parse(&a.to_npy(), Dtype::U8).unwrap(), a);
    }

    #[test]
    fn numpy_booleans_are_read_as_bytes() {
        let bytes = file("{'descr': '|b1', 'fortran_order': False, 'shape': (2,), }", &[1, 0]);
        assert_eq!(
            parse(&bytes, Dtype::U8).unwrap(),
            ArrayData::U8(array![1, 0].into_dyn().into())
        );
    }

    #[test]
    fn bad_files_get_one_clear_message() {
        let data = [0; 16];
        for (dictionary, expected) in [
            ("{'descr': '<f2', 'fortran_order': False, 'shape': (8,), }", "astype('<f8')"),
            ("{'descr': '<f16', 'fortran_order': False, 'shape': (1,), }", "dtype <f16, needs <f8"),
            ("{'descr': '<c16', 'fortran_order': False, 'shape': (1,), }", "complex (<c16)"),
            ("{'descr': '|O', 'fortran_order': False, 'shape': (2,), }", "dtype |O"),
            ("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (2,), }", "records"),
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
        assert!(parse(b"", Dtype::F64).unwrap_err().contains("is empty (0 bytes)"));
        assert!(parse(b"text", Dtype::F64).unwrap_err().contains("not a .npy"));
        assert!(parse(b"\x93NUMPY\x01\x00\xff\xff", Dtype::F64).unwrap_err().contains("header"));
        assert!(error(&"(".repeat(2000), &data).contains("header of 2001 bytes"));
        assert!(error(&"(".repeat(1000), &data).contains("broken header"));
        assert!(
            error(&format!("{}{}", "[".repeat(500), "]".repeat(500)), &data).contains("broken")
        );
    }

    /// Checks every element type of NumPy that is read, with two numbers in its own bytes, in both byte orders.
    #[test]
    fn other_element_types_are_converted_exactly() {
        let little: [(&str, Vec<u8>, [f64; 2]); 9] = [
            ("i1", [-3i8, 7].map(|v| v.to_le_bytes()).concat(), [-3.0, 7.0]),
            ("u1", vec![250, 7], [250.0, 7.0]),
            ("i2", [-300i16, 7].map(i16::to_le_bytes).concat(), [-300.0, 7.0]),
            ("u2", [60_000u16, 7].map(u16::to_le_bytes).concat(), [60_000.0, 7.0]),
            ("i4", [-70_000i32, 7].map(i32::to_le_bytes).concat(), [-70_000.0, 7.0]),
            ("u4", [4_000_000_000u32, 7].map(u32::to_le_bytes).concat(), [4e9, 7.0]),
            (
                "i8",
                [-(1i64 << 53), 7].map(i64::to_le_bytes).concat(),
                [-9_007_199_254_740_992.0, 7.0],
            ),
            ("u8", [1u64 << 63, 7].map(u64::to_le_bytes).concat(), [2f64.powi(63), 7.0]),
            ("f4", [0.1f32, 7.0].map(f32::to_le_bytes).concat(), [f64::from(0.1f32), 7.0]),
        ];
        let dictionary = |descriptor: &str, fortran: &str, shape: &str| {
            format!("{{'descr': '{descriptor}', 'fortran_order': {fortran}, 'shape': {shape}, }}")
        };
        for (name, bytes, expected) in little {
            let size = bytes.len() / 2;
            let big: Vec<u8> =
                bytes.chunks(size).flat_map(|item| item.iter().rev().copied()).collect();
            for (order, bytes) in [("<", &bytes), (">", &big)] {
                let order = if size == 1 { "|" } else { order };
                let header = dictionary(&format!("{order}{name}"), "False", "(2,)");
                let read = parse(&file(&header, bytes), Dtype::F64).unwrap();
                assert_eq!(
                    read,
                    ArrayData::F64(array![expected[0], expected[1]].into_dyn().into())
                );
            }
        }
        // Columns first: what is stored as 1 2 3 4 5 6 are the rows 1 3 5 and 2 4 6.
        let data = [1.0f64, 2.0, 3.0, 4.0, 5.0, 6.0].map(f64::to_be_bytes).concat();
        let read = parse(&file(&dictionary(">f8", "True", "(2, 3)"), &data), Dtype::F64).unwrap();
        assert_eq!(
            read,
            ArrayData::F64(array![[1.0, 3.0, 5.0], [2.0, 4.0, 6.0]].into_dyn().into())
        );

        // A value that would change is refused with its place.
        let data = [1i64, (1 << 53) + 1].map(i64::to_le_bytes).concat();
        let message = parse(&file(&dictionary("<i8", "False", "(2,)"), &data), Dtype::F64);
        let message = message.unwrap_err();
        assert!(message.contains("element [1] is 9007199254740993 of dtype <i8"), "{message}");
        let data = [0.0, 0.0, 0.5, 0.0f64].map(f64::to_le_bytes).concat();
        let message = parse(&file(&dictionary("<f8", "True", "(2, 2)"), &data), Dtype::I64);
        assert!(message.unwrap_err().contains("element [0, 1] is 0.5 of dtype <f8"));
        let data = [0.0, -4.0f64].map(f64::to_le_bytes).concat();
        let read = parse(&file(&dictionary("<f8", "False", "(2,)"), &data), Dtype::I64).unwrap();
        assert_eq!(read, ArrayData::I64(array![0, -4].into_dyn().into()));
    }

    proptest! {
        /// Checks that any damage to a valid file gives an array or a message, never a panic.
        #[test]
        fn damaged_files_never_panic(
            cut in 0..=192_usize, damage in prop::collection::vec((0..192_usize, any::<u8>()), 0..4),
        ) {
            let mut bytes = ArrayData::F64(ArrayD::zeros(vec![2, 4]).into()).to_npy();
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
