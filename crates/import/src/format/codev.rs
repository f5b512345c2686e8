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

/// The line of the parameters, as words, where this is such a file: after comments and a title.
fn parameters(text: &str) -> Option<(usize, Vec<&str>)> {
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.starts_with('!')).take(3);
    let is_kind = |line: &str| {
        let word = line.split_whitespace().next().unwrap_or_default();
        ["GRD", "ZFR", "ZRN", "SPI"].iter().any(|kind| word.eq_ignore_ascii_case(kind))
    };
    let (i, line) = lines.find(|(_, line)| is_kind(line))?;
    Some((i, line.split_whitespace().collect()))
}

pub(crate) fn is_codev(text: &str) -> bool {
    parameters(text).is_some_and(|(_, words)| {
        words.iter().any(|w| ["SSZ", "WVL"].iter().any(|key| w.eq_ignore_ascii_case(key)))
    })
}

/// Reads a grid.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let refuse = |problem: String, remedy: &str| Invalid::whole(NAME, problem, remedy);
    let again = "write it again as a grid (GRD) of a surface (SUR)";
    let text = text::text(NAME, bytes)?;
    let text = text.as_ref();
    let (line, words) =
        parameters(text).ok_or_else(|| refuse("has no line GRD after its title".into(), again))?;
    let kind = words[0].to_ascii_uppercase();
    if kind != "GRD" {
        return Err(refuse(format!("holds {kind}, polynomials, not a grid"), again));
    }
    let number = |k: usize| -> Result<f64, Invalid> {
        let word = words.get(k).copied().unwrap_or_default();
        let value = word.parse::<f64>().ok().filter(|v| v.is_finite());
        let message = || format!("has \"{word}\" in line {}, field {}", line + 1, k + 1);
        value.ok_or_else(|| refuse(message(), "write a number there"))
    };
    let after = |key: &str| -> Result<Option<f64>, Invalid> {
        let at = words.iter().position(|word| word.eq_ignore_ascii_case(key));
        at.map(|at| number(at + 1)).transpose()
    };
    let needed = |key: &str| {
        after(key)?.ok_or_else(|| refuse(format!("has no {key} in line {}", line + 1), again))
    };
    let of = |kind: &str| words.iter().any(|word| word.eq_ignore_ascii_case(kind));
    if of("FIL") {
        return Err(refuse("holds an intensity filter (FIL), no heights".into(), again));
    }
    let (columns, rows) = (number(1)?, number(2)?);
    // A float to an integer saturates; the size is checked next.
    let (columns, rows) = (columns as usize, rows as usize);
    let count = check_size("CODE V grid", rows, columns)?;
    let (um, scale) = (needed("WVL")?, needed("SSZ")?);
    let no_data = after("NDA")?.unwrap_or(32767.0);
    let mut values = Vec::new();
    for (i, line) in text.lines().enumerate().skip(line + 1) {
        if line.starts_with('!') {
            continue;
        }
        for (k, field) in line.split_whitespace().enumerate() {
            if values.len() == count {
                let problem = format!("has more than {count} numbers in line {}", i + 1);
                return Err(refuse(problem, "write as many as GRD says"));
            }
            values.push(text::number(NAME, field, i + 1, k + 1)?);
        }
    }
    if values.len() != count {
        let problem = format!("is truncated: {} of {count} pixels", values.len());
        return Err(refuse(problem, "write it again"));
    }
    let values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");
    let mut reading = Reading::new(Format::CodevInt, values, FirstRow::Top);
    reading.invalidate(no_data);
    (reading.unit, reading.factor) = (Some(Unit::named("waves")), 1.0 / scale);
    reading.wavelength_nm = Some(um * 1e3);
    if of("WFR") {
        let say = "the file holds a wavefront (WFR): `surface_per_value` 0.5 makes the surface of one reflection";
        reading.warnings.push(say.into());
    }
    let scales = [after("XSC")?.unwrap_or(1.0), after("YSC")?.unwrap_or(1.0)];
    if scales != [1.0; 2] {
        let say = format!(
            "XSC and YSC {scales:?} are not used: `pixel_mm` says how far the pixels are apart"
        );
        reading.warnings.push(say);
    }
    reading.stated =
        json!({ "wavelength_nm": um * 1e3, "ssz": scale, "nda": no_data, "wavefront": of("WFR") });
    Ok(reading)
}
