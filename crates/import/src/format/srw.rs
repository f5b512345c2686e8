//! Height map of SRW and Sirepo: a table with its coordinates, in metres.
//!
//! The corner is 0. The first line has the coordinates across the mirror (y), the first column those along it (x), so that a
//! line of the file is a column of the map. Tabs separate the numbers. The file states no unit: SRW works in metres. Source:
//! SRW, `srwl_opt_setup_surf_height_2d` (srwlib.py), whose first row is the transverse position.

use ndarray::Array2;
use planish_types::Invalid;

use crate::{
    Format, Unit,
    budget::{BYTES_PER_PIXEL, check_room, check_size, most_of},
    reading::{Coordinates, FirstRow, Reading},
    text,
};

const NAME: &str = "SRW file";

/// Largest coordinate, m, that is certainly in metres, and largest ratio of a height to the coordinates. Larger: tables
/// in mm are taken for those of SRW. Smaller: long mirrors are not recognised.
const LARGEST_IN_METRES: [f64; 2] = [10.0, 1e-2];

/// Returns true if the text begins as such a file does. It has a 0 in the corner, ascending coordinates separated by
/// tabs, and heights that are tiny beside them.
pub(crate) fn is_srw(text: &str) -> bool {
    let mut lines = text.lines().filter(|line| !text::is_comment(line) && !line.trim().is_empty());
    let all: Option<Vec<Vec<f64>>> = lines.by_ref().take(3).map(numbers).collect();
    let Some([first, second, third]) = all.as_deref() else { return false };
    first.first() == Some(&0.0)
        && first.len() > 2
        && first.len() == second.len()
        && first.len() == third.len()
        && first[1..].windows(2).all(|w| w[1] > w[0])
        && third[0] > second[0]
        && size(first).max(second[0].abs()) < LARGEST_IN_METRES[0]
        && size(&second[1..]) < LARGEST_IN_METRES[1] * (third[0] - second[0] + size(first))
}

/// Returns the numbers of a line whose separators are tabs; `None` for a line without tabs, with commas or semicolons,
/// or with words.
fn numbers(line: &str) -> Option<Vec<f64>> {
    if !line.contains('\t') || line.contains([',', ';']) {
        return None;
    }
    line.split_whitespace().take(1 << 16).map(|word| word.parse().ok()).collect()
}

/// Returns the largest magnitude of the values.
fn size(values: &[f64]) -> f64 {
    values.iter().fold(0.0_f64, |most, v| most.max(v.abs()))
}

/// Returns the message about a text that is no such file.
fn bad(problem: String) -> Invalid {
    let remedy = "write 0 and the y, then a line of x and its heights for every x";
    Invalid::whole(NAME, problem, remedy)
}

/// Reads the map. Refuses another corner than 0, words that are no numbers, and lines of another length than the first.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let most = most_of(BYTES_PER_PIXEL);
    let mut y = Vec::new();
    let mut x = Vec::new();
    let mut values = Vec::new();
    for (i, line) in text.lines().enumerate() {
        if line.trim().is_empty() || text::is_comment(line) {
            continue;
        }
        let mut row = Vec::new();
        for (k, word) in line.split_whitespace().enumerate() {
            if values.len() + row.len() >= most {
                check_room(NAME, values.len() + row.len(), BYTES_PER_PIXEL)?;
            }
            row.push(text::number(NAME, word, i + 1, k + 1)?);
        }
        if y.is_empty() {
            if row[0] != 0.0 {
                return Err(bad(format!("has {} in its corner, not 0", row[0])));
            }
            y = row.split_off(1);
            continue;
        }
        if row.len() != y.len() + 1 {
            let problem =
                format!("has {} numbers in line {}, {} before", row.len(), i + 1, y.len() + 1);
            return Err(bad(problem));
        }
        x.push(row[0]);
        values.extend(&row[1..]);
    }
    check_size("SRW map", y.len(), x.len())?;
    let values = Array2::from_shape_vec((x.len(), y.len()), values).expect("one value per pixel");
    let values = values.reversed_axes().as_standard_layout().into_owned();
    let mut reading = Reading::new(Format::Srw, values, FirstRow::SmallestY);
    reading.unit = Some(Unit::named("m"));
    reading.unit_by_custom = true;
    reading.coordinates = Some(Coordinates { x, y, unit: Some(Unit::named("m")) });
    let say = "read as a height map of SRW: x goes down the first column, y along the first line, in metres";
    reading.warnings.push(say.into());
    Ok(reading)
}
