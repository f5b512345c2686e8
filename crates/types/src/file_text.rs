//! Numbers read from the text of other programs: the one set of conveniences of all readers.
//!
//! Text is UTF-8, UTF-16 with its byte order mark, or Latin-1, in which older programs write `µm`.

use std::borrow::Cow;

use crate::Invalid;

/// Words that instruments and spreadsheets write for a pixel without a value.
const NO_DATA: [&str; 30] = [
    "",
    "nan",
    "nan(ind)",
    "-nan(ind)",
    "nan(snan)",
    "-nan(snan)",
    "1.#qnan",
    "-1.#qnan",
    "1.#snan",
    "1.#ind",
    "-1.#ind",
    "bad",
    "no data",
    "nodata",
    "no_data",
    "invalid",
    "void",
    "masked",
    "missing",
    "na",
    "n/a",
    "n.a.",
    "null",
    "none",
    "-",
    "--",
    "---",
    "#n/a",
    "#na",
    "#num!",
];

/// Words of a spreadsheet for a cell without a value that begin with `#`, which otherwise starts a comment.
const CELLS: [&str; 8] =
    ["#n/a", "#na", "#num!", "#div/0!", "#value!", "#ref!", "#null!", "#name?"];

/// Smallest share of a text in Latin-1 that is ASCII. Larger: refuses short headers with many letters beyond ASCII.
/// Smaller: takes bytes for text.
const LEAST_ASCII: f64 = 0.7;

/// Returns the text of a file, decoded from one of the encodings of the module. Refuses bytes that are not text; `name`
/// names them in the message.
pub fn text<'a>(name: &'static str, bytes: &'a [u8]) -> Result<Cow<'a, str>, Invalid> {
    let refused =
        || Invalid::whole(name, "is not text", "give the right `format`, or export as text");
    for (mark, unit) in [([0xFF, 0xFE], u16::from_le_bytes as fn([u8; 2]) -> u16), {
        ([0xFE, 0xFF], u16::from_be_bytes)
    }] {
        let Some(rest) = bytes.strip_prefix(&mark) else { continue };
        let units = rest.chunks_exact(2).map(|pair| unit([pair[0], pair[1]]));
        let text = char::decode_utf16(units).collect::<Result<String, _>>();
        let text = text.ok().filter(|text| rest.len().is_multiple_of(2) && !text.contains('\0'));
        return text.map(Cow::Owned).ok_or_else(refused);
    }
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    if let Ok(text) = std::str::from_utf8(bytes) {
        return if text.contains('\0') { Err(refused()) } else { Ok(Cow::Borrowed(text)) };
    }
    // Latin-1 has the numbers of Unicode; its control characters are in no text.
    let has_control = bytes.iter().any(|b| matches!(*b, 0..=8 | 14..=31 | 0x7F..=0x9F));
    let ascii = bytes.iter().filter(|b| b.is_ascii()).count();
    if !has_control && ascii as f64 >= LEAST_ASCII * bytes.len() as f64 {
        return Ok(Cow::Owned(bytes.iter().map(|b| char::from(*b)).collect()));
    }
    Err(refused())
}

/// Returns true for a line that starts with `#` or `%`, unless that is the first cell of a row of a spreadsheet, such
/// as `#N/A`.
pub fn is_comment(line: &str) -> bool {
    let line = line.trim_start();
    if line.starts_with('#') {
        let first = fields(line).next().unwrap_or_default().to_ascii_lowercase();
        return !CELLS.contains(&first.as_str());
    }
    line.starts_with('%')
}

/// Returns the separator of a line: comma, semicolon or tab, or `None` for white space.
fn separator(line: &str) -> Option<char> {
    [';', '\t', ','].into_iter().find(|c| line.contains(*c))
}

/// Returns true if a comma, semicolon or tab ends the line, and not white space or a value.
pub fn is_closed(line: &str) -> bool {
    let line = line.trim_matches([' ', '\r']);
    separator(line).is_some_and(|c| line.ends_with(c))
}

/// Splits a line into its fields: by semicolon, tab or comma, the first of these that it contains, else by white space.
/// A separator at the end of the line adds no empty field. Quotes around a field are removed.
pub fn fields<'a>(line: &'a str) -> Box<dyn Iterator<Item = &'a str> + 'a> {
    fn plain(field: &str) -> &str {
        let field = field.trim();
        let inner = field.strip_prefix('"').and_then(|field| field.strip_suffix('"'));
        inner.map_or(field, str::trim)
    }
    match separator(line) {
        Some(separator) => {
            let line = line.trim_matches([' ', '\r']);
            let line = line.strip_suffix(separator).unwrap_or(line);
            let mut is_quoted = false;
            // A separator between quotes is text.
            let parts = line.split(move |c| {
                is_quoted ^= c == '"';
                c == separator && !is_quoted
            });
            Box::new(parts.map(plain))
        }
        None => Box::new(line.split_whitespace().map(plain)),
    }
}

/// Returns a text of numbers with decimal points in the place of decimal commas, or `None` if it has no decimal commas.
/// `name` names the text in the message.
///
/// A comma is a decimal comma if no line has a decimal point, and every comma stands between two digits: in a line that
/// semicolons, tabs or blanks separate, or within quotes. Where three digits follow every one of them, they could
/// separate thousands, and the text is refused.
pub fn with_points(name: &'static str, text: &str) -> Result<Option<String>, Invalid> {
    let mut commas = Commas::default();
    let mut converted = String::with_capacity(text.len());
    for line in text.lines() {
        if line.trim().is_empty() || is_comment(line) {
            converted.push_str(line);
        } else if !commas.convert(line.trim_end(), &mut converted) {
            return Ok(None);
        }
        converted.push('\n');
    }
    if commas.count == 0 {
        return Ok(None);
    }
    if commas.are_thousands {
        let problem = "has commas before three digits each: decimal commas, or marks of thousands";
        return Err(Invalid::whole(name, problem, "write the numbers with a decimal point"));
    }
    converted.pop();
    Ok(Some(converted))
}

/// Decimal commas found in a text so far.
struct Commas {
    count: usize,
    /// True if every decimal comma so far could separate thousands.
    are_thousands: bool,
}

impl Default for Commas {
    fn default() -> Self {
        Self { count: 0, are_thousands: true }
    }
}

impl Commas {
    /// Appends `line` to `converted`, with points in the place of decimal commas. Returns false if a comma or a point
    /// shows that the commas of the text are not decimal.
    fn convert(&mut self, line: &str, converted: &mut String) -> bool {
        let b = line.as_bytes();
        let is_digit = |i: usize| b.get(i).is_some_and(u8::is_ascii_digit);
        let is_separated = line.trim().contains([';', '\t', ' ']);
        let mut is_quoted = false;
        let mut copied = 0;
        for (i, c) in b.iter().enumerate() {
            match c {
                b'"' => is_quoted = !is_quoted,
                b'.' if (is_digit(i + 1) || (i > 0 && is_digit(i - 1))) && !is_in_date(b, i) => {
                    return false;
                }
                b',' => {
                    let is_between = i > 0 && is_digit(i - 1) && is_digit(i + 1);
                    let is_separator =
                        !is_quoted && (b.get(i + 1) == Some(&b'"') || (i > 0 && b[i - 1] == b'"'));
                    if is_separator {
                        continue;
                    }
                    if !is_between || !(is_quoted || is_separated) {
                        return false;
                    }
                    self.count += 1;
                    self.are_thousands &= separates_thousands(b, i);
                    converted.push_str(&line[copied..i]);
                    converted.push('.');
                    copied = i + 1;
                }
                _ => {}
            }
        }
        converted.push_str(&line[copied..]);
        true
    }
}

/// Returns true if the point at byte `i` is one of two in a date such as `1.3.2026`.
fn is_in_date(b: &[u8], i: usize) -> bool {
    let start = b[..i].iter().rposition(|c| !is_of_date(*c)).map_or(0, |k| k + 1);
    let date = b[start..].iter().take_while(|c| is_of_date(**c));
    date.filter(|c| **c == b'.').count() == 2
}

/// Returns true for a digit or a point.
fn is_of_date(c: u8) -> bool {
    c.is_ascii_digit() || c == b'.'
}

/// Returns true if the comma at byte `i` could separate thousands: three digits follow it, and one to three that do not
/// begin with 0 stand before it.
fn separates_thousands(b: &[u8], i: usize) -> bool {
    let after = b[i + 1..].iter().take_while(|c| c.is_ascii_digit()).count();
    let before = b[..i].iter().rev().take_while(|c| c.is_ascii_digit()).count();
    after == 3 && (1..=3).contains(&before) && b[i - before] != b'0'
}

/// Warning that a reader adds if [`with_points`] changed a text.
pub const DECIMAL_COMMAS: &str = "the numbers have a decimal comma";

/// Returns the number that `field` states, or NaN for one of the words for no data. Refuses other text; `line` and
/// `column`, which count from 1, are for the message.
pub fn number(name: &'static str, field: &str, line: usize, column: usize) -> Result<f64, Invalid> {
    if let Ok(v) = field.parse::<f64>() {
        return Ok(v);
    }
    if is_no_data(field) {
        return Ok(f64::NAN);
    }
    let short: String = field.chars().filter(|c| !c.is_control()).take(20).collect();
    let is_complex = field.ends_with(['i', 'j', 'I', 'J', ')']) && field.contains(['+', '-']);
    let remedy = if is_complex && field.contains(|c: char| c.is_ascii_digit()) {
        "complex numbers are not read: save their real part"
    } else {
        "write numbers with a decimal point; a line of text starts with #"
    };
    let problem =
        format!("has \"{short}\" in line {line}, field {column}, where a number should be");
    Err(Invalid::whole(name, problem, remedy))
}

/// Returns true for a word that means no value, such as `BAD`, `#N/A` or `***`.
pub fn is_no_data(field: &str) -> bool {
    let word = field.to_ascii_lowercase();
    NO_DATA.contains(&word.as_str())
        || CELLS.contains(&word.as_str())
        || field.bytes().all(|c| c == b'*')
}

/// Returns true for a line of column names: no field is a number, and at least one is not a word for no data.
pub fn is_names(line: &str) -> bool {
    fields(line).all(|field| field.parse::<f64>().is_err()) && !fields(line).all(is_no_data)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_in_its_four_encodings() {
        let of = |bytes: &[u8]| text("file", bytes).map(Cow::into_owned).ok();
        let right = Some("1 µm\n".to_string());
        assert_eq!(of("1 µm\n".as_bytes()), right);
        assert_eq!(of(b"1 \xB5m\n"), right);
        assert_eq!(of(b"\xFF\xFE1\0 \0\xB5\0m\0\n\0"), right);
        assert_eq!(of(b"\xFE\xFF\x001\0 \0\xB5\0m\0\n"), right);
        // Bytes, not text: a NUL, half a unit, a control character beside Latin-1.
        assert_eq!((of(b"1\0"), of(b"\xFF\xFE1"), of(b"12345678\xB5\x01")), (None, None, None));
    }

    #[test]
    fn fields_quotes_and_comments() {
        let all = |line: &str| fields(line).map(String::from).collect::<Vec<_>>();
        assert_eq!(all("\"1.5\", \"a,b\",\"\",\r"), ["1.5", "a,b", ""]);
        assert_eq!(all("1,,2"), ["1", "", "2"]);
        assert_eq!(all("\t\t"), ["", ""]);
        assert!(is_closed("1,2,") && !is_closed("1,2") && !is_closed("1 2 "));
        assert!(is_comment("# a") && is_comment(" % b") && !is_comment("#N/A,1"));
        assert!(is_no_data("***") && is_no_data("#NUM!") && !is_no_data("x"));
        assert!(is_names("x,y,z") && !is_names("BAD,BAD") && !is_names("x,1,2"));
    }

    #[test]
    fn a_comma_is_a_decimal_one_only_where_nothing_else_is_possible() {
        let of = |text: &str| with_points("file", text);
        assert_eq!(of("1,5;2\n3;-4,25e-3").unwrap().as_deref(), Some("1.5;2\n3;-4.25e-3"));
        assert_eq!(of("# a, b\n1,5 2,25\n").unwrap().as_deref(), Some("# a, b\n1.5 2.25"));
        assert_eq!(of("\"1,5\";\"2,5\"\n").unwrap().as_deref(), Some("\"1.5\";\"2.5\""));
        assert_eq!(of("\"1,5\",\"2,5\"\n").unwrap().as_deref(), Some("\"1.5\",\"2.5\""));
        assert_eq!(of("1.3.2026;2,5\n").unwrap().as_deref(), Some("1.3.2026;2.5"));
        // A number of thousands does not begin with 0.
        assert_eq!(of("0,500;0,250\n").unwrap().as_deref(), Some("0.500;0.250"));
        for other in ["1,5,2\n", "1, 2\n", "1.5;2,5\n", "1;2\n", "\"1,5\",2,5\n"] {
            assert_eq!(of(other).unwrap(), None, "{other}");
        }
        assert!(of("1,500;2,250\n").unwrap_err().to_string().contains("thousands"));
    }
}
