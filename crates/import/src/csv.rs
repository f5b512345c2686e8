//! A matrix of numbers as text: one line per row, fields separated by comma, semicolon, tab or
//! white space. Lines that start with `#` are comments; an empty field, `nan`, `bad` or `no data`
//! is an invalid pixel. Neither unit nor pitch are in such a file.

use ndarray::Array2;
use planish_types::Invalid;

use crate::{
    Format,
    budget::{BYTES_PER_PIXEL, check_room, check_size, most_of},
    reading::{FirstRow, Reading},
    text,
};

const NAME: &str = "CSV file";

/// Reads a matrix.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let mut values = Vec::new();
    let (mut rows, mut columns) = (0, 0);
    let most = most_of(BYTES_PER_PIXEL);
    for (i, line) in text::text(NAME, bytes)?.lines().enumerate() {
        if line.trim().is_empty() || line.trim_start().starts_with('#') {
            continue;
        }
        let before = values.len();
        for (k, field) in text::fields(line).enumerate() {
            if values.len() >= most {
                check_room(NAME, values.len(), BYTES_PER_PIXEL)?;
            }
            values.push(text::number(NAME, field, i + 1, k + 1)?);
        }
        let found = values.len() - before;
        if rows > 0 && found != columns {
            let problem = format!("has {found} fields in line {}, {columns} before", i + 1);
            return Err(Invalid::whole(NAME, problem, "give every row as many numbers"));
        }
        columns = found;
        rows += 1;
    }
    if rows == 0 {
        return Err(Invalid::whole(NAME, "holds no numbers", "give a matrix, one line per row"));
    }
    check_size(NAME, rows, columns)?;
    let values = Array2::from_shape_vec((rows, columns), values).expect("every row has its fields");
    Ok(Reading::new(Format::Csv, values, FirstRow::SmallestY))
}
