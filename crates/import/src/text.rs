//! Numbers read from text.

use planish_types::Invalid;

/// Words that instruments and spreadsheets write for a pixel without a value.
const NO_DATA: [&str; 6] = ["nan", "bad", "no data", "nodata", "n/a", ""];

/// The text of a file; refuses what is not text.
pub(crate) fn text<'a>(name: &'static str, bytes: &'a [u8]) -> Result<&'a str, Invalid> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    match std::str::from_utf8(bytes) {
        Ok(text) if !text.contains('\0') => Ok(text),
        _ => Err(Invalid::whole(name, "is not text", "give the right `format`, or export as text")),
    }
}

/// The fields of a line: by comma, semicolon or tab where there is one, else by white space.
pub(crate) fn fields<'a>(line: &'a str) -> Box<dyn Iterator<Item = &'a str> + 'a> {
    match [';', '\t', ','].into_iter().find(|c| line.contains(*c)) {
        Some(separator) => {
            let line = line.trim_matches([' ', '\r']);
            // A separator at the end of a line closes it.
            let line = line.strip_suffix(separator).unwrap_or(line);
            Box::new(line.split(separator).map(str::trim))
        }
        None => Box::new(line.split_whitespace()),
    }
}

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
    if NO_DATA.contains(&field.to_ascii_lowercase().as_str()) {
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
