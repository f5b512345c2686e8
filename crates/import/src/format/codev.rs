//! CODE V interferogram file `.int` on a grid.
//!
//! Lines that start with `!` are comments. A title follows, then `GRD columns rows SUR WVL w SSZ s NDA n`, then whole
//! numbers:
//!
//! ```text
//! height (waves of w um) = raw / s
//! ```
//!
//! `raw = n` is an invalid pixel. `SUR` is a surface, `WFR` a wavefront. The numbers go along +x, the first row is the
//! top (+y). The file has no pitch: CODE V fits the grid to an aperture. Source: CODE V reference manual, "Interferogram
//! files".

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::check_size,
    reading::{FirstRow, Reading},
    text,
};

const NAME: &str = "CODE V file";

/// The line of a CODE V file that states kind, size and scale of the grid.
struct Parameters<'a> {
    /// Index of the line in the file, from 0.
    line: usize,
    words: Vec<&'a str>,
}

impl<'a> Parameters<'a> {
    /// Returns the line of the parameters, which stands among the first three lines that are no comments; `None` if the
    /// text has none.
    fn find(text: &'a str) -> Option<Self> {
        let lines = text.lines().enumerate().filter(|(_, l)| !l.starts_with('!')).take(3);
        let mut lines =
            lines.map(|(line, text)| Self { line, words: text.split_whitespace().collect() });
        lines.find(|parameters| {
            let word = parameters.words.first().copied().unwrap_or_default();
            ["GRD", "ZFR", "ZRN", "SPI"].iter().any(|kind| word.eq_ignore_ascii_case(kind))
        })
    }

    /// Returns the index of a word in the line, in upper or lower case; `None` without it.
    fn position(&self, key: &str) -> Option<usize> {
        self.words.iter().position(|word| word.eq_ignore_ascii_case(key))
    }

    /// Returns the number in the word with index `k`. Refuses a word that is no finite number.
    fn number(&self, k: usize) -> Result<f64, Invalid> {
        let word = self.words.get(k).copied().unwrap_or_default();
        word.parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(|| {
            let problem = format!("has \"{word}\" in line {}, field {}", self.line + 1, k + 1);
            Invalid::whole(NAME, problem, "write a number there")
        })
    }

    /// Returns the number after the word `key`; `None` if the word is absent. Refuses another word there.
    fn after(&self, key: &str) -> Result<Option<f64>, Invalid> {
        self.position(key).map(|k| self.number(k + 1)).transpose()
    }

    /// Returns the number after the word `key`. Refuses its absence.
    fn needed(&self, key: &str) -> Result<f64, Invalid> {
        let missing = format!("has no {key} in line {}", self.line + 1);
        self.after(key)?.ok_or_else(|| Invalid::whole(NAME, missing, AGAIN))
    }
}

/// Returns true if the text has the line of parameters of a CODE V interferogram, with SSZ or WVL in it.
pub(crate) fn is_codev(text: &str) -> bool {
    Parameters::find(text)
        .is_some_and(|p| p.position("SSZ").is_some() || p.position("WVL").is_some())
}

/// Remedy in the messages about a file without a readable grid of heights.
const AGAIN: &str = "write it again as a grid (GRD) of a surface (SUR)";

/// Reads the map of a CODE V file. Refuses polynomials, intensity filters, a grid without WVL or SSZ, and another
/// number of heights than pixels.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let text = text.as_ref();
    let parameters = Parameters::find(text)
        .ok_or_else(|| Invalid::whole(NAME, "has no line GRD after its title", AGAIN))?;
    let kind = parameters.words[0].to_ascii_uppercase();
    if kind != "GRD" {
        let problem = format!("holds {kind}, polynomials, not a grid");
        return Err(Invalid::whole(NAME, problem, AGAIN));
    }
    if parameters.position("FIL").is_some() {
        return Err(Invalid::whole(NAME, "holds an intensity filter (FIL), no heights", AGAIN));
    }
    // A float to an integer saturates; the size is checked next.
    let [columns, rows] = [parameters.number(1)? as usize, parameters.number(2)? as usize];
    let count = check_size("CODE V grid", rows, columns)?;
    let um = parameters.needed("WVL")?;
    let scale = parameters.needed("SSZ")?;
    let no_data = parameters.after("NDA")?.unwrap_or(32767.0);
    let mut values = Vec::new();
    for (i, line) in text.lines().enumerate().skip(parameters.line + 1) {
        if line.starts_with('!') {
            continue;
        }
        for (k, field) in line.split_whitespace().enumerate() {
            if values.len() == count {
                let problem = format!("has more than {count} numbers in line {}", i + 1);
                return Err(Invalid::whole(NAME, problem, "write as many as GRD says"));
            }
            values.push(text::number(NAME, field, i + 1, k + 1)?);
        }
    }
    if values.len() != count {
        let problem = format!("is truncated: {} of {count} pixels", values.len());
        return Err(Invalid::whole(NAME, problem, "write it again"));
    }
    let values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");
    let mut reading = Reading::new(Format::CodevInt, values, FirstRow::Top);
    reading.invalidate(no_data);
    reading.unit = Some(Unit::named("waves"));
    reading.factor = 1.0 / scale;
    reading.wavelength_nm = Some(um * 1e3);
    let is_wavefront = parameters.position("WFR").is_some();
    if is_wavefront {
        let say = "the file holds a wavefront (WFR): `surface_per_value` 0.5 makes the surface of one reflection";
        reading.warnings.push(say.into());
    }
    let scales = [parameters.after("XSC")?.unwrap_or(1.0), parameters.after("YSC")?.unwrap_or(1.0)];
    if scales != [1.0; 2] {
        let say = format!(
            "XSC and YSC {scales:?} are not used: `pixel_mm` says how far the pixels are apart"
        );
        reading.warnings.push(say);
    }
    reading.stated = json!({ "wavelength_nm": um * 1e3, "ssz": scale, "nda": no_data, "wavefront": is_wavefront });
    Ok(reading)
}
