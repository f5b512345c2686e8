//! Checks that every solver makes first: the bounds of the dwell times and the weights of the
//! pixels.

use ndarray::{Array2, Zip};
use planish_types::{Invalid, Surface, ToolPath};
use serde::Serialize;

/// A bound on the dwell times.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Bound {
    /// One time for every dwell point, s.
    Seconds(f64),
    /// Proportional to the length of the segment, s/mm.
    SecondsPerMm(f64),
}

impl Bound {
    /// The bound of every dwell point (n), s.
    fn times_s(self, name: &'static str, path: &ToolPath) -> Result<Vec<f64>, Invalid> {
        let (Self::Seconds(value) | Self::SecondsPerMm(value)) = self;
        if !(value.is_finite() && value >= 0.0) {
            return Err(Invalid::whole(name, format!("is {value}"), "give a finite bound >= 0"));
        }
        Ok((0..path.len())
            .map(|j| match self {
                Self::Seconds(t) => t,
                Self::SecondsPerMm(tau) => tau * path.segment_length_mm(j),
            })
            .collect())
    }
}

/// Lower bound of every dwell point (n), s.
pub fn lower(path: &ToolPath, min_dwell: Bound) -> Result<Vec<f64>, Invalid> {
    let lo = min_dwell.times_s("min_dwell", path)?;
    if let Some(j) = lo.iter().position(|t| *t > LONGEST_FLOOR_S) {
        let problem = format!("is {:?} s", lo[j]);
        let remedy = format!("a least dwell time is at most {LONGEST_FLOOR_S:e} s; give seconds");
        return Err(Invalid::at("min_dwell", j, problem, remedy));
    }
    Ok(lo)
}

/// Upper bound of every dwell point (n), s.
pub fn upper(path: &ToolPath, max_dwell: Option<Bound>) -> Result<Vec<f64>, Invalid> {
    match max_dwell {
        Some(bound) => bound.times_s("max_dwell", path),
        None => Ok(vec![f64::INFINITY; path.len()]),
    }
}

/// Largest lower bound of one dwell time that is accepted, s (1e7 s are four months). A larger one
/// is refused as a mistake in the units. Larger: such mistakes pass. Smaller: long dwell times of
/// weak tools are refused.
const LONGEST_FLOOR_S: f64 = 1e7;

/// The given weights, zero on invalid pixels.
pub fn pixel_weights(
    desired: &Surface,
    weight: Option<&Array2<f64>>,
) -> Result<Array2<f64>, Invalid> {
    let height = desired.height_nm();
    let mut w = Zip::from(height).par_map_collect(|z| if z.is_nan() { 0.0 } else { 1.0 });
    if let Some(given) = weight {
        if given.dim() != height.dim() {
            let problem = format!("has shape {:?}, the map {:?}", given.dim(), height.dim());
            return Err(Invalid::whole("weight", problem, "give one weight per pixel"));
        }
        let bad = given.indexed_iter().find(|(_, v)| !(v.is_finite() && **v >= 0.0));
        if let Some((index, v)) = bad {
            return Err(Invalid::at("weight", index, format!("is {v}"), "give weights >= 0"));
        }
        w *= given;
        if w.iter().all(|v| *v == 0.0) {
            return Err(Invalid::whole("weight", "is 0 on every valid pixel", "give a weight > 0"));
        }
    }
    Ok(w)
}
