//! Cells of comma-separated values, which a spreadsheet opens.

/// Returns a value as the text of a cell; empty if there is none.
pub(crate) fn cell(value: Option<impl ToString>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}

/// Returns a word as the text of a cell. A spreadsheet may evaluate a text that begins with `=`, `+`, `-`, `@`, a tab
/// or a carriage return as a formula. An apostrophe before it, which the spreadsheet does not show, prevents that.
pub(crate) fn text_cell(word: &str) -> String {
    if word.starts_with(['=', '+', '-', '@', '\t', '\r']) {
        format!("'{word}")
    } else {
        word.into()
    }
}

/// Returns the text of a cell with quotation marks if RFC 4180 (comma-separated values) requires them.
pub(crate) fn quoted(cell: &str) -> String {
    if cell.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", cell.replace('"', "\"\""))
    } else {
        cell.into()
    }
}
