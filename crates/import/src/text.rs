//! Numbers read from text.
//!
//! Text is UTF-8, UTF-16 with its byte order mark, or Latin-1, in which older programs write `µm`.

use std::borrow::Cow;

use planish_types::Invalid;

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

/// Words of a spreadsheet for a cell without a value that begin with the sign of a comment.
const CELLS: [&str; 8] =
    ["#n/a", "#na", "#num!", "#div/0!", "#value!", "#ref!", "#null!", "#name?"];

/// Smallest share of a text in Latin-1 that is ASCII. Larger: refuses short headers with many letters beyond ASCII.
/// Smaller: takes bytes for text.
const LEAST_ASCII: f64 = 0.7;

/// The text of a file; refuses what is not text.
pub(crate) fn text<'a>(name: &'static str, bytes: &'a [u8]) -> Result<Cow<'a, str>, Invalid> {
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
    let is_text = |b: &u8| !matches!(*b, 0..=8 | 14..=31 | 0x7F..=0x9F);
    let ascii = bytes.iter().filter(|b| b.is_ascii()).count();
    if bytes.iter().all(is_text) && ascii as f64 >= LEAST_ASCII * bytes.len() as f64 {
        return Ok(Cow::Owned(bytes.iter().map(|b| char::from(*b)).collect()));
    }
    Err(refused())
}

/// True for a line that starts with `#` or `%`, unless that is the first cell of a row of a spreadsheet, such as `#N/A`.
pub(crate) fn is_comment(line: &str) -> bool {
    let line = line.trim_start();
    let first = || fields(line).next().unwrap_or_default().to_ascii_lowercase();
    line.starts_with('%') || (line.starts_with('#') && !CELLS.contains(&first().as_str()))
}

/// The separator of a line: comma, semicolon or tab where there is one, else white space.
fn separator(line: &str) -> Option<char> {
    [';', '\t', ','].into_iter().find(|c| line.contains(*c))
}

/// True if a separator that is no white space ends the line: nothing follows it.
pub(crate) fn is_closed(line: &str) -> bool {
    let line = line.trim_matches([' ', '\r']);
    separator(line).is_some_and(|c| line.ends_with(c))
}

/// The fields of a line: by comma, semicolon or tab where there is one, else by white space. A separator at the end of the
/// line closes it. Quotes around a field are no part of it.
pub(crate) fn fields<'a>(line: &'a str) -> Box<dyn Iterator<Item = &'a str> + 'a> {
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

/// A text of numbers with decimal points in the place of decimal commas; `None` where it has none.
///
/// A comma is a decimal comma if no line has a point, and every comma stands between two digits in a line that
/// semicolons, tabs or blanks separate. Where three digits follow every one of them, they could separate thousands, and
/// the text is refused.
pub(crate) fn with_points(name: &'static str, text: &str) -> Result<Option<String>, Invalid> {
    let mut commas = 0usize;
    let mut thousands = true;
    let is_line = |line: &&str| !line.trim().is_empty() && !is_comment(line);
    for line in text.lines().filter(is_line) {
        let b = line.trim().as_bytes();
        let is_separated = b.iter().any(|c| matches!(c, b';' | b'\t' | b' '));
        if b.contains(&b'.') || b.contains(&b'"') || !is_separated {
            return Ok(None);
        }
        for (i, _) in b.iter().enumerate().filter(|(_, c)| **c == b',') {
            let is_digit = |at: usize| b.get(at).is_some_and(u8::is_ascii_digit);
            if i == 0 || !is_digit(i - 1) || !is_digit(i + 1) {
                return Ok(None);
            }
            commas += 1;
            thousands &= is_digit(i + 2) && is_digit(i + 3) && !is_digit(i + 4);
        }
    }
    if commas == 0 {
        return Ok(None);
    }
    if thousands {
        let problem = "has commas before three digits each: decimal commas, or marks of thousands";
        return Err(Invalid::whole(name, problem, "write the numbers with a decimal point"));
    }
    let line = |line: &str| match is_comment(line) {
        true => line.to_string(),
        false => line.replace(',', "."),
    };
    Ok(Some(text.lines().map(line).collect::<Vec<_>>().join("\n")))
}

/// The warning where [`with_points`] changed a text.
pub(crate) const DECIMAL_COMMAS: &str = "the numbers have a decimal comma";

/// A number, NaN for one of the words for no data; `line` counts from 1, `field` too.
pub(crate) fn number(
    name: &'static str,
    field: &str,
    line: usize,
    column: usize,
) -> Result<f64, Invalid> {
    if let Ok(v) = field.parse::<f64>() {
        return Ok(v);
    }
    if is_no_data(field) {
        return Ok(f64::NAN);
    }
    let short: String = field.chars().filter(|c| !c.is_control()).take(20).collect();
    let is_complex = field.ends_with(['i', 'j', 'I', 'J', ')']) && field.contains(['+', '-']);
    let remedy = match is_complex && field.contains(|c: char| c.is_ascii_digit()) {
        true => "complex numbers are not read: save their real part",
        false => "write numbers with a decimal point; a line of text starts with #",
    };
    let problem =
        format!("has \"{short}\" in line {line}, field {column}, where a number should be");
    Err(Invalid::whole(name, problem, remedy))
}

/// True for a word that means no value, such as `BAD`, `#N/A` or `***`.
pub(crate) fn is_no_data(field: &str) -> bool {
    let word = field.to_ascii_lowercase();
    NO_DATA.contains(&word.as_str())
        || CELLS.contains(&word.as_str())
        || field.bytes().all(|c| c == b'*')
}

/// True where a line has no number, and a word that means no value is not all it has: a line of names.
pub(crate) fn is_names(line: &str) -> bool {
    let is_word = |field: &str| field.parse::<f64>().is_err();
    fields(line).all(is_word) && !fields(line).all(is_no_data)
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
        for other in ["1,5,2\n", "1, 2\n", "1.5;2,5\n", "1;2\n", "\"1,5\";\"2,5\"\n"] {
            assert_eq!(of(other).unwrap(), None, "{other}");
        }
        assert!(of("1,500;2,250\n").unwrap_err().to_string().contains("thousands"));
    }
}
