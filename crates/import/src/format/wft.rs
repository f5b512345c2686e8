//! Wavefront of DFTFringe and OpenFringe, `.wft`: numbers of columns and rows, then a value per line.
//!
//! ```text
//! surface height = value / 2      in wavelengths of `Lambda` (nm): the light is reflected once
//! pitch          = DIAM / 2 rx    in mm
//! ```
//!
//! The values go along +x, and the last row of the picture comes first. Words follow: `outside ellipse cx cy rx ry` in
//! pixels from the upper left, outside of which there is no mirror, `obstruction ellipse cx cy rx ry`, inside of which there
//! is none if its radius is not 0, `DIAM` (mm), `ROC` (mm) and `Lambda` (nm). The middle of the outer ellipse has the
//! coordinate 0. Source: files of DFTFringe, whose reader counts rows from the bottom.

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::check_size,
    reading::{FirstRow, Reading, Rule},
    text,
};

const NAME: &str = "wft file";

/// Surface height per wavefront height: 0.5 for one reflection.
const SURFACE_PER_WAVEFRONT: f64 = 0.5;

/// Returns true if two whole numbers of at least 2 come first, and one of the words of this format stands in the last
/// 2000 bytes.
pub(crate) fn is_wft(text: &str) -> bool {
    let mut words = text.split_whitespace();
    let is_count =
        |word: Option<&str>| word.is_some_and(|w| w.parse::<u32>().is_ok_and(|n| n >= 2));
    let end = text.len().saturating_sub(2000);
    let end = (end..text.len()).find(|i| text.is_char_boundary(*i)).unwrap_or(text.len());
    is_count(words.next())
        && is_count(words.next())
        && ["outside ellipse", "DIAM", "Lambda"]
            .iter()
            .any(|key| text[end..].contains(&format!("\n{key} ")))
}

/// An ellipse in the picture: centre and radii [x, y] in pixels, counted from the upper left.
#[derive(Clone, Copy)]
struct Ellipse {
    centre: [f64; 2],
    radii: [f64; 2],
}

impl Ellipse {
    /// Returns true if the pixel, by its column and its row from the top, lies in the ellipse or on its edge.
    fn holds(&self, column: f64, row: f64) -> bool {
        let [u, v] =
            [(column - self.centre[0]) / self.radii[0], (row - self.centre[1]) / self.radii[1]];
        // Rounding of the radii.
        u * u + v * v <= 1.0 + 1e-9
    }
}

/// Content of a file: its numbers, of which the first two are those of columns and rows, and the lines after them as
/// words, with their line numbers.
struct Contents<'a> {
    numbers: Vec<f64>,
    lines: Vec<(usize, Vec<&'a str>)>,
}

/// Returns the message about a damaged `.wft` file.
fn bad(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "save it again in DFTFringe")
}

impl<'a> Contents<'a> {
    fn read(text: &'a str) -> Result<Self, Invalid> {
        let mut numbers: Vec<f64> = Vec::new();
        let mut lines: Vec<(usize, Vec<&str>)> = Vec::new();
        let mut count = 2;
        for (i, line) in text.lines().enumerate() {
            let fields: Vec<&str> = line.split_whitespace().collect();
            if numbers.len() == count && !fields.is_empty() {
                lines.push((i + 1, fields));
                continue;
            }
            for (k, field) in fields.iter().enumerate() {
                numbers.push(text::number(NAME, field, i + 1, k + 1)?);
                if let ([columns, rows], 2) = (&numbers[..], count) {
                    // A float to an integer saturates.
                    count = 2 + check_size("wavefront", *rows as usize, *columns as usize)?;
                }
                if numbers.len() > count {
                    return Err(bad(format!("has more values than pixels in line {}", i + 1)));
                }
            }
        }
        if numbers.len() != count || count == 2 {
            return Err(bad(format!("is truncated: {} of {count} values", numbers.len())));
        }
        Ok(Self { numbers, lines })
    }

    /// Returns the numbers in the line that begins with the words `key`; `None` without such a line. Refuses words
    /// among the numbers.
    fn after(&self, key: &[&str]) -> Result<Option<Vec<f64>>, Invalid> {
        let Some((line, fields)) = self.lines.iter().find(|(_, f)| f.starts_with(key)) else {
            return Ok(None);
        };
        let all = fields[key.len()..].iter().enumerate();
        let all = all.map(|(k, field)| text::number(NAME, field, *line, key.len() + k + 1));
        all.collect::<Result<Vec<f64>, _>>().map(Some)
    }

    fn ellipse(&self, key: &[&str]) -> Result<Option<Ellipse>, Invalid> {
        match self.after(key)?.as_deref() {
            None => Ok(None),
            Some([x, y, rx, ry, ..]) if [x, y, rx, ry].iter().all(|v| v.is_finite()) => {
                Ok(Some(Ellipse { centre: [*x, *y], radii: [*rx, *ry] }))
            }
            Some(other) => Err(bad(format!("has \"{}\" with {other:?}", key.join(" ")))),
        }
    }

    /// Returns the positive number after the word `key`; `None` without the word. Refuses a number that is not
    /// positive.
    fn positive(&self, key: &str) -> Result<Option<f64>, Invalid> {
        match self.after(&[key])?.as_deref() {
            None => Ok(None),
            Some([v, ..]) if v.is_finite() && *v > 0.0 => Ok(Some(*v)),
            Some(other) => Err(bad(format!("has {key} with {other:?}"))),
        }
    }
}

/// Reads the map of surface heights. Refuses damaged files, another number of values than pixels, and an outer ellipse
/// whose radii are not positive.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let mut contents = Contents::read(&text)?;
    let [columns, rows] = [0, 1].map(|k| contents.numbers[k] as usize);
    let outside = contents.ellipse(&["outside", "ellipse"])?;
    if let Some(e) = outside.filter(|e| !e.radii.iter().all(|r| *r > 0.0)) {
        return Err(bad(format!("has an outside ellipse of the radii {:?}", e.radii)));
    }
    let obstruction =
        contents.ellipse(&["obstruction", "ellipse"])?.filter(|e| e.radii.iter().all(|r| *r > 0.0));
    let values = Array2::from_shape_vec((rows, columns), contents.numbers.split_off(2));
    let mut values = values.expect("one value per pixel");
    for ((r, c), value) in values.indexed_iter_mut() {
        // The first row of the file is the last one of the picture.
        let column = c as f64;
        let row = (rows - 1 - r) as f64;
        let is_outside = outside.is_some_and(|e| !e.holds(column, row));
        if is_outside || obstruction.is_some_and(|e| e.holds(column, row)) {
            *value = f64::NAN;
        }
    }
    let mut reading = Reading::new(Format::Wft, values, FirstRow::SmallestY);
    reading.unit = Some(Unit::named("waves"));
    reading.factor = SURFACE_PER_WAVEFRONT;
    reading.scale_applied = Some(SURFACE_PER_WAVEFRONT);
    reading.wavelength_nm = contents.positive("Lambda")?;
    let diameter_mm = contents.positive("DIAM")?;
    match (outside, diameter_mm) {
        (Some(e), Some(diameter_mm)) => {
            let pitch = diameter_mm / (2.0 * e.radii[0]);
            let last = (rows - 1) as f64;
            reading.rule = Some(Rule {
                step: [pitch; 2],
                unit: [Some(Unit::named("mm")); 2],
                reference: Some([(e.centre[0], 0.0), (last - e.centre[1], 0.0)]),
            });
        }
        (Some(_), None) => reading.warnings.push("the file has no DIAM: it states no pitch".into()),
        (None, _) => reading.warnings.push(
            "the file has no outside ellipse: it states no pitch, and which pixels are on the mirror is not known".into(),
        ),
    }
    reading.warnings.push(
        "heights are half of the wavefront, as light is reflected once: the surface of the mirror"
            .into(),
    );
    reading.stated = json!({
        "wavelength_nm": reading.wavelength_nm,
        "diameter_mm": diameter_mm,
        "radius_of_curvature_mm": contents.positive("ROC")?,
        "obstructed": obstruction.is_some(),
    });
    Ok(reading)
}
