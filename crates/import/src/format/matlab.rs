//! MATLAB `.mat`, version 5 (also 6 and 7): named matrices, column by column, compressed or not.
//!
//! Only real numeric matrices are read; cells, arrays of structures and text are passed over. A field of a structure has
//! the name `structure.field`, also in structures within structures. Of compressed variables that are not asked for only
//! the header is inflated, of compressed structures everything. The customary
//! names `X Y Z` and `Xtif Ytif Ztif` are found by themselves. A matrix has neither unit nor pitch, but variables beside it
//! may state them (`pixel_mm = 0.5`, `unit = 'nm/min'`), and its name may have its unit (`rate_nm_per_min`).

use std::{borrow::Cow, io::Read};

use flate2::read::ZlibDecoder;
use ndarray::{Array2, ShapeBuilder};
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format,
    arrays::{Arrays, TURNED, choose, is_turned, named_coordinates, prefix, upright},
    beside::{Beside, Variable as Statement},
    budget::{MOST_ARRAYS, check_elements, check_size, too_many},
    bytes::{Bytes, Number},
    reading::{FirstRow, Pick, Reading},
};

const NAME: &str = "MAT file";
/// Size of the header of a file, bytes (MAT-File Format, version 5).
const HEADER: usize = 128;

/// Type code of a data element that holds a matrix.
const MATRIX: u32 = 14;
/// Type code of a data element whose content is another data element, compressed.
const COMPRESSED: u32 = 15;

/// Number of bytes of a compressed variable that are inflated to read its flags, dimensions and name. Larger: more time
/// on files with many variables. Smaller: a long name does not fit. Chosen: ample, as MATLAB allows names of 63
/// characters.
const LONGEST_HEADER: usize = 4096;

/// Class code of an array that is a structure (MAT-File Format, table 1-3).
const STRUCTURE: u32 = 2;

/// Class code of an array that is text (MAT-File Format, table 1-3).
const TEXT: u32 = 4;

/// Longest text that is read, bytes; a longer one is passed over. Larger: more time on files with long texts. Smaller:
/// long statements are not seen.
const LONGEST_TEXT: usize = 200;

/// Largest depth of structures within structures. Larger: more time and stack on a hostile file. Smaller: nested
/// structures are passed over.
const MOST_LEVELS: usize = 8;

/// A variable of a file: its name, shape and type, and where its numbers stand.
struct Variable<'a> {
    name: String,
    rows: usize,
    columns: usize,
    is_complex: bool,
    /// True if the numbers are truth values.
    is_logical: bool,
    /// Text of an array of letters; `None` for numbers.
    text: Option<String>,
    number: Number,
    /// Data element of the file that holds the variable, compressed or not.
    element: Element<'a>,
    /// Offset of the numbers in the inflated content of the element, and their length `len`, bytes.
    start: usize,
    len: usize,
    /// True for a field of a structure; the element then may hold further fields after its numbers.
    is_field: bool,
}

/// Reads the matrix that `pick` names; without a name a customary one, or the only matrix of the file.
///
/// # Errors
/// Refuses damaged files, several matrices without a name, names of absent matrices, and complex numbers.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    let mut b = Bytes { all: bytes, name: NAME, big_endian: false };
    if !bytes.starts_with(b"MATLAB 5.0") {
        let problem = "does not start with MATLAB 5.0";
        return Err(Invalid::whole(NAME, problem, "save with -v7, or give the right `format`"));
    }
    b.big_endian = match b.slice(126, 2)? {
        b"IM" => false,
        b"MI" => true,
        other => return Err(broken(format!("has the byte order mark {other:02X?}"))),
    };
    let (texts, variables): (Vec<_>, Vec<_>) =
        variables(&b)?.into_iter().partition(|variable| variable.text.is_some());
    let mut arrays = Arrays::default();
    for v in &variables {
        let named = (v.name.clone(), vec![v.rows as u64, v.columns as u64]);
        if v.is_logical {
            arrays.marks.push(named);
        } else if !v.is_complex {
            arrays.numbers.push(named);
        }
    }
    let pick = choose(&arrays, pick, NAME).map_err(|e| {
        let first = variables.iter().find(|v| v.is_complex).filter(|_| arrays.numbers.is_empty());
        first.map_or(e, holds_complex)
    })?;
    let name = pick.dataset.as_deref().unwrap_or_default();
    let map = find(&variables, name)?;
    let values = map.matrix(b.big_endian)?;
    check_size("matrix", values.nrows(), values.ncols())?;
    let coordinates = match (&pick.x, &pick.y) {
        (Some(x), Some(y)) => Some([
            find(&variables, x)?.matrix(b.big_endian)?,
            find(&variables, y)?.matrix(b.big_endian)?,
        ]),
        _ => None,
    };
    let is_turned = coordinates.as_ref().is_some_and(|[x, y]| is_turned(x, y, values.dim()));
    let values = upright(values, is_turned);
    let (rows, columns) = values.dim();
    let mut reading = Reading::new(Format::Mat5, values, FirstRow::SmallestY);
    reading.single = map.number == Number::F32;
    if let Some(mask) = &pick.mask {
        let values = find(&variables, mask)?.matrix(b.big_endian)?;
        reading.apply_mask(mask, &upright(values, is_turned))?;
    }
    if is_turned {
        reading.warnings.push(TURNED.into());
    }
    reading.state_unit_of_name(&name[prefix(name).len()..]);
    if let Some(coordinates) = coordinates {
        let [x, y] = coordinates.map(|matrix| upright(matrix, is_turned));
        reading.coordinates = Some(named_coordinates(&pick, &x, &y, (rows, columns))?);
    }
    let beside = texts.iter().chain(&variables);
    let beside = beside.filter(|v| [prefix(name), ""].contains(&prefix(&v.name)));
    statements(beside, b.big_endian)?.apply(&mut reading)?;
    reading.stated = json!({ "dataset": name, "x": pick.x, "y": pick.y, "mask": pick.mask });
    Ok(reading)
}

/// Returns the numeric matrix called `name`, or refuses its absence.
fn find<'a, 'b>(variables: &'b [Variable<'a>], name: &str) -> Result<&'b Variable<'a>, Invalid> {
    variables.iter().find(|v| v.name == name).ok_or_else(|| {
        let names: Vec<&str> = variables.iter().map(|v| v.name.as_str()).take(20).collect();
        let problem = format!("has no numeric matrix \"{name}\"");
        Invalid::whole(NAME, problem, format!("it holds: {}", names.join(", ")))
    })
}

/// Returns the message about a matrix of complex numbers.
fn holds_complex(variable: &Variable) -> Invalid {
    let problem = format!("holds complex numbers in \"{}\"", variable.name);
    Invalid::whole(NAME, problem, "save their real part, or choose another with `dataset`")
}

/// Returns the statements in texts and in variables of one number, such as `pixel_mm = 0.5`.
fn statements<'a>(
    variables: impl Iterator<Item = &'a Variable<'a>>,
    big_endian: bool,
) -> Result<Beside, Invalid> {
    let mut statements = Vec::new();
    for variable in variables {
        let value = match &variable.text {
            Some(text) => text.clone(),
            None if variable.rows * variable.columns == 1 && !variable.is_complex => {
                variable.matrix(big_endian)?[[0, 0]].to_string()
            }
            None => continue,
        };
        let key = variable.name[prefix(&variable.name).len()..].to_string();
        statements.push(Statement { key, value, place: "variable".into() });
    }
    let mut beside = Beside::default();
    beside.add_variables(&statements)?;
    Ok(beside)
}

/// Returns the message about a damaged MATLAB file.
fn broken(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "save it again with -v7")
}

/// Returns the headers of all numeric matrices, real and complex, and of texts. Of compressed matrices only the header
/// is inflated, of compressed structures everything. Refuses too many variables, and damaged ones.
fn variables<'a>(b: &Bytes<'a>) -> Result<Vec<Variable<'a>>, Invalid> {
    let mut variables = Vec::new();
    let mut start = HEADER;
    let mut count = 0;
    while start < b.all.len() {
        let element = element(b, start)?;
        start = element.next;
        count += 1;
        if count > MOST_ARRAYS {
            return Err(too_many(NAME, MOST_ARRAYS, "variables", "save only the map"));
        }
        match element.kind {
            MATRIX => {
                let whole = Content { element, big_endian: b.big_endian };
                whole.matrices(element.data, element.data.len(), 0, &[], &mut variables)?;
            }
            COMPRESSED => {
                let mut head = inflate(element.data, LONGEST_HEADER)?;
                let inner = Bytes { all: &head, ..*b };
                let size = inner.u32(4)? as usize;
                if inner.u32(0)? != MATRIX {
                    continue;
                }
                if class_of(&Bytes { all: inner.slice(8, head.len() - 8)?, ..*b })? == STRUCTURE {
                    check_elements("structure", &[size as u64 / 8])?;
                    head = inflate(element.data, 8 + size)?;
                }
                let whole = Content { element, big_endian: b.big_endian };
                whole.matrices(&head[8..], size, 0, &[], &mut variables)?;
            }
            _ => {}
        }
        if variables.len() > MOST_ARRAYS {
            return Err(too_many(NAME, MOST_ARRAYS, "variables", "save only the map"));
        }
    }
    Ok(variables)
}

/// Returns the class code (number, text, structure, ...) of the matrix whose content begins at the first byte.
fn class_of(b: &Bytes) -> Result<u32, Invalid> {
    let flags = element(b, 0)?;
    Ok(Bytes { all: flags.data, ..*b }.u32(0)? & 0xff)
}

/// A data element at the top level of the file, in whose content matrices are looked for.
#[derive(Clone, Copy)]
struct Content<'a> {
    element: Element<'a>,
    big_endian: bool,
}

impl<'a> Content<'a> {
    /// Appends a numeric matrix or text, or the fields of a structure, to `found`. `head` are the first bytes of its
    /// content of `size` bytes, which begins at byte `start` of the content of the top element. `path` are the names of
    /// the surrounding structures, and its own; it is empty at the top.
    fn matrices(
        self,
        head: &[u8],
        size: usize,
        start: usize,
        path: &[String],
        found: &mut Vec<Variable<'a>>,
    ) -> Result<(), Invalid> {
        let b = Bytes { all: head, name: NAME, big_endian: self.big_endian };
        if head.is_empty() {
            return Ok(());
        }
        if class_of(&b)? != STRUCTURE {
            if let Some(mut variable) = matrix(head, size, self.element, self.big_endian)? {
                variable.start += start;
                variable.is_field = !path.is_empty();
                if !path.is_empty() {
                    variable.name = path.join(".");
                }
                found.push(variable);
            }
            return Ok(());
        }
        let dimensions = element(&b, element(&b, 0)?.next)?;
        let sizes = Bytes { all: dimensions.data, ..b };
        let is_single = dimensions.data.len() == 8 && sizes.i32(0)? == 1 && sizes.i32(4)? == 1;
        if !is_single || path.len() >= MOST_LEVELS {
            return Ok(());
        }
        let name = element(&b, dimensions.next)?;
        let length = element(&b, name.next)?;
        let length_of_names = Bytes { all: length.data, ..b }.u32(0)? as usize;
        let names = element(&b, length.next)?;
        if length_of_names == 0 {
            return Ok(());
        }
        let own = match path {
            [] => vec![String::from_utf8_lossy(name.data).into_owned()],
            path => path.to_vec(),
        };
        let mut next = names.next;
        for field in names.data.chunks(length_of_names) {
            let end = field.iter().position(|c| *c == 0).unwrap_or(field.len());
            let mut path = own.clone();
            path.push(String::from_utf8_lossy(&field[..end]).into_owned());
            let Tag { kind, size, start: begin, next: after } = tag(&b, next)?;
            let content = b.slice(begin, size)?;
            next = after;
            if kind == MATRIX {
                self.matrices(content, size, start + begin, &path, found)?;
            }
            if found.len() > MOST_ARRAYS {
                return Err(too_many(NAME, MOST_ARRAYS, "variables", "save only the map"));
            }
        }
        Ok(())
    }
}

impl Variable<'_> {
    /// Returns the numbers of the matrix (rows, columns). Refuses complex numbers, too many, and data that is cut off.
    fn matrix(&self, big_endian: bool) -> Result<Array2<f64>, Invalid> {
        if self.is_complex {
            return Err(holds_complex(self));
        }
        let count = check_elements("matrix", &[self.rows as u64, self.columns as u64])?;
        let values = self.number.decode(&self.data()?, count, big_endian)?;
        let matrix = Array2::from_shape_vec((self.rows, self.columns).f(), values)
            .map_err(|_| self.truncated())?;
        Ok(matrix.as_standard_layout().into_owned())
    }

    /// Returns the message about a variable whose numbers end too early.
    fn truncated(&self) -> Invalid {
        broken(format!("is truncated in \"{}\"", self.name))
    }

    /// Returns the bytes of the numbers, inflated if they are compressed. Refuses an element that is cut off, broken,
    /// or longer than its header says.
    fn data(&self) -> Result<Cow<'_, [u8]>, Invalid> {
        if self.element.kind == MATRIX {
            let data = self.element.data.get(self.start..self.start + self.len);
            return data.map(Cow::Borrowed).ok_or_else(|| self.truncated());
        }
        // The tag of the matrix comes first, the padding to 8 bytes last.
        let start = 8 + self.start;
        let most = (start + self.len).next_multiple_of(8);
        let mut all = inflate(self.element.data, most + 1)?;
        if all.len() > most && !self.is_field {
            let problem = format!("grows beyond the {most} bytes of \"{}\"", self.name);
            return Err(broken(problem));
        }
        if all.len() < start + self.len {
            return Err(self.truncated());
        }
        all.truncate(start + self.len);
        all.drain(..start);
        Ok(Cow::Owned(all))
    }
}

/// A data element: type code (`kind`), content, and offset of the next element, bytes.
#[derive(Clone, Copy)]
struct Element<'a> {
    kind: u32,
    data: &'a [u8],
    next: usize,
}

/// Head of a data element: type code, length of the content (bytes), its offset, and the offset of the next element.
struct Tag {
    kind: u32,
    size: usize,
    start: usize,
    next: usize,
}

/// Reads the head of the data element at byte `start`. Refuses a small element of more than 4 bytes.
fn tag(b: &Bytes, start: usize) -> Result<Tag, Invalid> {
    let word = b.u32(start)?;
    if word >> 16 != 0 {
        // The small format: size and type in one word, up to 4 bytes after it.
        let (kind, size) = (word & 0xffff, (word >> 16) as usize);
        if size > 4 {
            return Err(broken(format!("has a small element of {size} bytes at byte {start}")));
        }
        return Ok(Tag { kind, size, start: start + 4, next: start + 8 });
    }
    let size = b.u32(start + 4)? as usize;
    // Elements start at multiples of 8 bytes, but compressed ones follow each other.
    let padded = if word == COMPRESSED { size } else { size.div_ceil(8) * 8 };
    Ok(Tag { kind: word, size, start: start + 8, next: start + 8 + padded })
}

/// Reads the data element at byte `start`. Refuses one that ends after the bytes that are there.
fn element<'a>(b: &Bytes<'a>, start: usize) -> Result<Element<'a>, Invalid> {
    let Tag { kind, size, start, next } = tag(b, start)?;
    Ok(Element { kind, data: b.slice(start, size)?, next })
}

/// Reads the header of a numeric matrix or a text from `head`, the first bytes of its content of `size` bytes. Returns
/// `None` for anything else, for more than two axes, and for no numbers.
fn matrix<'a>(
    head: &[u8],
    size: usize,
    whole: Element<'a>,
    big_endian: bool,
) -> Result<Option<Variable<'a>>, Invalid> {
    let b = Bytes { all: head, name: NAME, big_endian };
    let flags = element(&b, 0)?;
    let word = Bytes { all: flags.data, ..b }.u32(0)?;
    let class = word & 0xff;
    let is_complex = word & 0x800 != 0;
    let is_logical = word & 0x200 != 0;
    // Classes 6 .. 15: double, single, int8 .. uint64; 4 is text.
    if !(6..=15).contains(&class) && class != TEXT {
        return Ok(None);
    }
    let dimensions = element(&b, flags.next)?;
    if dimensions.data.len() != 8 {
        return Ok(None);
    }
    let name = element(&b, dimensions.next)?;
    let name_text = String::from_utf8_lossy(name.data).into_owned();
    let sizes = Bytes { all: dimensions.data, ..b };
    let [rows, columns] = [sizes.i32(0)?, sizes.i32(4)?];
    let (Ok(rows), Ok(columns)) = (usize::try_from(rows), usize::try_from(columns)) else {
        return Err(broken(format!("has \"{name_text}\" of {rows} x {columns}")));
    };
    if rows * columns == 0 {
        return Ok(None);
    }
    let values = tag(&b, name.next)?;
    let mut variable = Variable {
        name: name_text,
        rows,
        columns,
        is_complex,
        is_logical,
        text: None,
        number: Number::U8,
        element: whole,
        start: values.start,
        len: values.size,
        is_field: false,
    };
    if class == TEXT {
        variable.text = text_of(&b, &values);
        return Ok(if variable.text.is_some() { Some(variable) } else { None });
    }
    variable.number = match values.kind {
        1 => Number::I8,
        2 => Number::U8,
        3 => Number::I16,
        4 => Number::U16,
        5 => Number::I32,
        6 => Number::U32,
        7 => Number::F32,
        9 => Number::F64,
        12 => Number::I64,
        13 => Number::U64,
        other => return Err(broken(format!("has \"{}\" stored as type {other}", variable.name))),
    };
    let len = rows.checked_mul(columns).and_then(|n| n.checked_mul(variable.number.size()));
    if len != Some(values.size) || values.start + values.size > size {
        let name = &variable.name;
        let problem = format!("has \"{name}\" of {rows} x {columns} in {} bytes", values.size);
        return Err(broken(problem));
    }
    Ok(Some(variable))
}

/// Returns the text of an array of letters, whose content has the head `values`. Returns `None` if it is longer than
/// [`LONGEST_TEXT`], cut off, or of another type.
fn text_of(b: &Bytes, values: &Tag) -> Option<String> {
    if values.size > LONGEST_TEXT {
        return None;
    }
    let bytes = b.slice(values.start, values.size).ok()?;
    match values.kind {
        // Bytes, and UTF-8.
        1 | 2 | 16 => Some(String::from_utf8_lossy(bytes).into_owned()),
        // 16-bit numbers, and UTF-16.
        4 | 17 => {
            let pairs = bytes.chunks_exact(2).map(|pair| {
                let pair = [pair[0], pair[1]];
                if b.big_endian { u16::from_be_bytes(pair) } else { u16::from_le_bytes(pair) }
            });
            Some(char::decode_utf16(pairs).map(|c| c.unwrap_or('?')).collect())
        }
        _ => None,
    }
}

/// Inflates `compressed` up to its first `most` bytes. The checksum is verified only if the inflated data ends before
/// them. Refuses broken data.
fn inflate(compressed: &[u8], most: usize) -> Result<Vec<u8>, Invalid> {
    let mut out = Vec::new();
    let stream = ZlibDecoder::new(compressed).take(most as u64);
    // Memory grows with the inflated bytes, not with the size that a header claims.
    { stream }
        .read_to_end(&mut out)
        .map_err(|e| broken(format!("is truncated or broken in a compressed element ({e})")))?;
    Ok(out)
}
