//! A matrix of numbers as text: one line per row, fields separated by comma, semicolon, tab or
//! white space. Lines that start with `#` are comments; an empty field, `nan`, `bad` or `no data`
//! is an invalid pixel. Neither unit nor pitch are in such a file.

use ndarray::Array2;
use planish_types::Invalid;

use crate::{
    Format, MOST_PIXELS, check_size,
    reading::{FirstRow, Reading},
    text,
};

const NAME: &str = "CSV file";

/// Reads a matrix.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let mut values = Vec::new();
    let (mut rows, mut columns) = (0, 0);
    for (i, line) in text::text(NAME, bytes)?.lines().enumerate() {
        if line.trim().is_empty() || line.trim_start().starts_with('#') {
            continue;
        }
        let fields = text::fields(line);
        if rows > 0 && fields.len() != columns {
            let problem =
                format!("has {} fields in line {}, {columns} before", fields.len(), i + 1);
            return Err(Invalid::whole(NAME, problem, "give every row as many numbers"));
        }
        columns = fields.len();
        rows += 1;
        if values.len() + columns > MOST_PIXELS {
            check_size(NAME, rows, columns)?;
        }
        for (k, field) in fields.iter().enumerate() {
            values.push(text::number(NAME, field, i + 1, k + 1)?);
        }
    }
    check_size(NAME, rows, columns)?;
    let values = Array2::from_shape_vec((rows, columns), values).expect("every row has its fields");
    Ok(Reading::new(Format::Csv, values, FirstRow::SmallestY))
}
