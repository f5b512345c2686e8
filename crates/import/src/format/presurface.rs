//! SHADOW presurface: a map as text.
//!
//! `nx ny`, then the ny coordinates y, then for each of nx coordinates its x and its ny heights. White space and the ends
//! of lines separate the numbers alike. The file has no units: SHADOW works in the user's, OASYS writes metres. Source:
//! SHADOW's user guide, "PRESURFACE".

use ndarray::Array2;
use planish_types::Invalid;

use crate::{
    Format,
    budget::{check_elements, check_size},
    reading::{Coordinates, FirstRow, Reading},
    text,
};

const NAME: &str = "presurface file";

/// Smallest number of coordinates per axis at which a text of numbers counts as this format. Smaller: other tables pass
/// for it.
const FEWEST: usize = 3;

/// Returns true if the text holds as many numbers as the sizes in its first line require, and both sizes are at least
/// [`FEWEST`].
pub(crate) fn is_presurface(text: &str) -> bool {
    let mut lines = text.lines();
    let sizes = lines.next().unwrap_or_default().split_whitespace();
    let sizes: Vec<Option<usize>> = sizes.take(3).map(|word| word.parse().ok()).collect();
    let [Some(nx), Some(ny)] = sizes[..] else { return false };
    let mut second = lines.next().unwrap_or_default().split_whitespace().take(4);
    let count = ny.checked_add(1).and_then(|n| n.checked_mul(nx)).and_then(|n| n.checked_add(ny));
    nx >= FEWEST
        && ny >= FEWEST
        && second.all(|word| word.parse::<f64>().is_ok())
        && count == Some(text.split_whitespace().count() - 2)
}

/// Returns the message about a text that is no presurface file.
fn bad(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "write nx ny, the y, then x and its heights, line by line")
}

/// Reads the map of heights. Refuses another number of heights than pixels, and words that are no numbers.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let text = text.as_ref();
    let mut words = text.lines().enumerate().flat_map(|(i, line)| {
        line.split_whitespace().enumerate().map(move |(k, word)| (i + 1, k + 1, word))
    });
    let mut next = |what: &str| -> Result<f64, Invalid> {
        let (line, field, word) =
            words.next().ok_or_else(|| bad(format!("is truncated: it has no {what}")))?;
        text::number(NAME, word, line, field)
    };
    // A float to an integer saturates; the size is checked next.
    let columns = next("nx")? as usize;
    let rows = next("ny")? as usize;
    check_size("presurface", rows, columns)?;
    check_elements("presurface", &[rows as u64 + 1, columns as u64 + 1])?;
    let mut y = Vec::new();
    for _ in 0..rows {
        y.push(next("coordinate y")?);
    }
    let mut x = Vec::new();
    let mut values = Vec::new();
    for _ in 0..columns {
        x.push(next("coordinate x")?);
        for _ in 0..rows {
            values.push(next("height")?);
        }
    }
    if let Some((line, field, _)) = words.next() {
        let problem =
            format!("has more than {columns} x {rows} heights in line {line}, field {field}");
        return Err(bad(problem));
    }
    let values = Array2::from_shape_vec((columns, rows), values).expect("one value per pixel");
    let values = values.reversed_axes().as_standard_layout().into_owned();
    let mut reading = Reading::new(Format::Presurface, values, FirstRow::SmallestY);
    reading.coordinates = Some(Coordinates { x, y, unit: None });
    Ok(reading)
}
