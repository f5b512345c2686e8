//! Zemax OpticStudio grid sag `.dat`: a line of parameters, then a line per pixel.
//!
//! `nx ny delx dely unitflag xdec ydec`, then nx ny lines `z dz/dx dz/dy d2z/dxdy nodata`. The unit flag is 0 for mm, 1 for
//! cm, 2 for inches, 3 for m, of z and of the steps. The first pixel is the upper left (-x, +y); the lines go along +x.
//! The middle of the grid lies at (xdec, ydec). The last number, which may be left out, is 1 at an invalid pixel. Lines
//! that start with `!` are comments. The derivatives are not read. Source: OpticStudio help, "Grid Sag", "Importing Grid
//! Data".

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::check_size,
    reading::{Coordinates, FirstRow, Reading},
    text,
};

const NAME: &str = "grid sag file";

/// Returns true if the line is empty or a comment.
fn is_comment(line: &str) -> bool {
    line.trim().is_empty() || line.trim_start().starts_with('!')
}

/// Returns true if the text begins with a line of 7 parameters and a line of a pixel with 4 or 5 numbers, as grid sag
/// files do.
pub(crate) fn is_grid_sag(text: &str) -> bool {
    let lines = text.lines().filter(|line| !is_comment(line)).take(2);
    let numbers: Option<Vec<Vec<f64>>> = lines
        .map(|line| line.split_whitespace().take(8).map(|word| word.parse().ok()).collect())
        .collect();
    let Some([first, second]) = numbers.as_deref() else { return false };
    first.len() == 7
        && first[..2].iter().all(|count| *count >= 2.0 && count.fract() == 0.0)
        && [0.0, 1.0, 2.0, 3.0].contains(&first[4])
        && (4..=5).contains(&second.len())
}

/// Returns the message about a text that is no grid sag file.
fn bad(problem: String) -> Invalid {
    let remedy = "write nx ny delx dely unitflag xdec ydec, then a line per pixel";
    Invalid::whole(NAME, problem, remedy)
}

/// Reads the map of heights (sag). Refuses another number of lines than pixels, lines with other than 4 or 5 numbers,
/// and unknown units.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let text = text.as_ref();
    let mut lines = text.lines().enumerate().filter(|(_, line)| !is_comment(line));
    let (i, first) = lines.next().ok_or_else(|| bad("holds no numbers".into()))?;
    let mut head = [0.0; 7];
    let words: Vec<&str> = first.split_whitespace().take(8).collect();
    if !(5..=7).contains(&words.len()) {
        return Err(bad(format!("has {} numbers in line {}", words.len(), i + 1)));
    }
    for (k, word) in words.iter().enumerate() {
        head[k] = text::number(NAME, word, i + 1, k + 1)?;
    }
    let [columns, rows, dx, dy, flag, x0, y0] = head;
    let [columns, rows] = [columns, rows].map(|size| size as usize);
    let count = check_size("grid", rows, columns)?;
    let mm = match flag {
        0.0 => 1.0,
        1.0 => 10.0,
        2.0 => 25.4,
        3.0 => 1000.0,
        other => return Err(bad(format!("has the unit flag {other}, not 0, 1, 2 or 3"))),
    };
    let mut values = Vec::new();
    for (i, line) in lines {
        if values.len() == count {
            return Err(bad(format!("has more than {count} pixels in line {}", i + 1)));
        }
        let mut fields = [0.0; 5];
        let mut numbers = 0;
        for (k, word) in line.split_whitespace().enumerate() {
            if k == 5 {
                return Err(bad(format!("has more than 5 numbers in line {}", i + 1)));
            }
            fields[k] = text::number(NAME, word, i + 1, k + 1)?;
            numbers = k + 1;
        }
        if numbers < 4 {
            return Err(bad(format!(
                "has {numbers} numbers in line {}, not 4 or 5: is it truncated?",
                i + 1
            )));
        }
        values.push(if fields[4] != 0.0 { f64::NAN } else { fields[0] });
    }
    if values.len() != count {
        return Err(bad(format!("is truncated: {} of {count} pixels", values.len())));
    }
    let values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");
    let mut reading = Reading::new(Format::GridSag, values, FirstRow::Top);
    reading.unit = Some(Unit::named("mm"));
    reading.factor = mm;
    let [x, y] = [(columns, dx.abs(), x0), (rows, -dy.abs(), y0)].map(|(len, step, middle)| {
        let half = (len as f64 - 1.0) / 2.0;
        (0..len).map(|i| (middle + (i as f64 - half) * step) * mm).collect()
    });
    reading.coordinates = Some(Coordinates { x, y, unit: Some(Unit::named("mm")) });
    reading.stated = json!({ "unit_flag": flag, "decentre": [x0, y0] });
    Ok(reading)
}
