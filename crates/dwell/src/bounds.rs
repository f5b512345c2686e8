//! Bounds of the dwell times and weights of the pixels, with the checks that every solver makes first.

use ndarray::{Array2, Zip};
use planish_types::{Invalid, Surface, ToolPath};
use serde::Serialize;

/// A lower or an upper bound on the dwell times.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Bound {
    /// The same time for every dwell point, s.
    Seconds(f64),
    /// Time per length of the segment, the same for every segment, s/mm.
    SecondsPerMm(f64),
}

impl Bound {
    /// Returns the bound of every dwell point (n), s.
    ///
    /// # Errors
    /// Refuses a bound that is negative or not finite.
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

/// Returns the lower bound of every dwell point (n), s.
///
/// # Errors
/// Refuses a bound that is negative or not finite, and one above [`LONGEST_FLOOR_S`].
pub fn lower(path: &ToolPath, min_dwell: Bound) -> Result<Vec<f64>, Invalid> {
    let lo = min_dwell.times_s("min_dwell", path)?;
    if let Some(j) = lo.iter().position(|t| *t > LONGEST_FLOOR_S) {
        let problem = format!("is {:?} s", lo[j]);
        let remedy = format!("a least dwell time is at most {LONGEST_FLOOR_S:e} s; give seconds");
        return Err(Invalid::at_index("min_dwell", j, problem, remedy));
    }
    Ok(lo)
}

/// Returns the upper bound of every dwell point (n), s; infinite without a bound.
///
/// # Errors
/// Refuses a bound that is negative or not finite.
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

/// Returns the weights of the pixels (ny, nx), zero on invalid pixels. Without `weight` they follow from the standard
/// deviations of the map, if it has any ([`weights_of_deviations`]), and are 1 otherwise.
///
/// # Errors
/// Refuses weights of another shape, weights that are negative or not finite, and weights that are 0 on every valid
/// pixel.
pub fn pixel_weights(
    desired: &Surface,
    weight: Option<&Array2<f64>>,
) -> Result<Array2<f64>, Invalid> {
    let height = desired.height_nm();
    let mut w = Zip::from(height).map_collect(|z| if z.is_nan() { 0.0 } else { 1.0 });
    if let Some(weight) = weight {
        if weight.dim() != height.dim() {
            let problem = format!("has shape {:?}, the map {:?}", weight.dim(), height.dim());
            return Err(Invalid::whole("weight", problem, "give one weight per pixel"));
        }
        let bad = weight.indexed_iter().find(|(_, v)| !(v.is_finite() && **v >= 0.0));
        if let Some((index, v)) = bad {
            return Err(Invalid::at_index("weight", index, format!("is {v}"), "give weights >= 0"));
        }
        w *= weight;
        if w.iter().all(|v| *v == 0.0) {
            return Err(Invalid::whole("weight", "is 0 on every valid pixel", "give a weight > 0"));
        }
    } else if let Some(weights) = weights_of_deviations(desired) {
        w *= &weights;
    }
    Ok(w)
}

/// Returns the weights of the pixels (ny, nx) from the standard deviations s of their heights; `None` for a map without
/// known deviations, or with deviations that are all 0.
///
/// ```text
/// w = 2 m^2 / (m^2 + s^2),    m^2 = mean of s^2 over the valid pixels with a known s
/// ```
///
/// The best weight of a height with a *known* deviation is proportional to 1 / s^2. The s of a few measurements
/// scatters, so that some pixels have a tiny s by chance; they would decide the plan. The variance is therefore the
/// mean of that of the pixel and that of the map. A weight is at most 2, and 1 for a pixel with s = m. A pixel of an
/// unknown deviation has s = m. The shrinkage of variances towards their mean is that of G. K. Smyth, Stat. Appl.
/// Genet. Mol. Biol. 3 (2004) 3, with as many degrees of freedom for the map as for the pixel.
fn weights_of_deviations(desired: &Surface) -> Option<Array2<f64>> {
    let deviation = desired.deviation_nm()?;
    let mean_nm = desired.noise_rms_nm()?;
    if mean_nm == 0.0 {
        return None;
    }
    let mean = mean_nm * mean_nm;
    Some(deviation.map(|s| if s.is_nan() { 1.0 } else { 2.0 * mean / (mean + s * s) }))
}

/// Returns the RMS of the standard deviations of the map under the weights of its pixels, nm: the noise level that a
/// residual can reach. `None` for a map without deviations, or if they are 0 or unknown on all pixels that count.
///
/// ```text
/// sqrt(sum w s^2 / sum w)     over the valid pixels with a known s
/// ```
///
/// # Errors
/// Refuses weights as `pixel_weights` does, if the map has deviations.
pub fn noise_of_deviations(
    desired: &Surface,
    weight: Option<&Array2<f64>>,
) -> Result<Option<f64>, Invalid> {
    let Some(deviation) = desired.deviation_nm() else { return Ok(None) };
    let weight = pixel_weights(desired, weight)?;
    let known = weight.iter().zip(deviation).filter(|(_, s)| !s.is_nan());
    let (squares, sum) = known.fold((0.0, 0.0), |(q, t), (w, s)| (q + w * s * s, t + w));
    Ok(if squares > 0.0 { Some((squares / sum).sqrt()) } else { None })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;
    use planish_types::{Axis, Grid};

    #[test]
    fn deviations_become_weights_unless_weights_are_given() {
        let axis = Axis::new(0.0, 1.0, 2).unwrap();
        let map = array![[1.0, 2.0], [3.0, f64::NAN]];
        let plain = Surface::new(Grid { x: axis, y: axis }, map).unwrap();
        assert_eq!(pixel_weights(&plain, None).unwrap(), array![[1.0, 1.0], [1.0, 0.0]]);
        // m^2 = (1 + 7) / 2 = 4: weights 8 / 5 and 8 / 11, and 1 where the deviation is unknown.
        let root = 7.0_f64.sqrt();
        let measured = plain.clone().with_deviation(array![[1.0, root], [f64::NAN, 1.0]]).unwrap();
        let w = pixel_weights(&measured, None).unwrap();
        let want = array![[1.6, 8.0 / 11.0], [1.0, 0.0]];
        // Below: rounding of quotients of the order 1.
        assert!(w.iter().zip(&want).all(|(w, v)| (w - v).abs() < 1e-14), "{w}");
        // (1.6 * 1 + 8/11 * 7) / (1.6 + 8/11)
        let noise = noise_of_deviations(&measured, None).unwrap().unwrap();
        let want = (1.6 + 56.0 / 11.0) / (1.6 + 8.0 / 11.0);
        // Rounding, as above.
        assert!((noise * noise - want).abs() < 1e-13, "{noise}");
        let given = array![[1.0, 0.0], [2.0, 5.0]];
        assert_eq!(noise_of_deviations(&measured, Some(&given)).unwrap(), Some(1.0));
        let w = pixel_weights(&measured, Some(&given)).unwrap();
        assert_eq!(w, array![[1.0, 0.0], [2.0, 0.0]]);
        // Deviations of 0 say nothing.
        let exact = plain.with_deviation(Array2::zeros((2, 2))).unwrap();
        assert_eq!(pixel_weights(&exact, None).unwrap(), array![[1.0, 1.0], [1.0, 0.0]]);
    }
}
