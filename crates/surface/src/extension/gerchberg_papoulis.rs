//! Extension by the continuation without spatial frequencies above a cutoff.
//!
//! ```text
//! z_0     = nearest extension
//! z_(k+1) = valid pixels: z as measured;  others: L z_k
//! L       = low pass |f| <= f_c of the enlarged map, continued periodically
//! ```
//!
//! Each step is a projection onto a set that contains every band-limited surface, so the error of such a
//! surface falls with every step, but ever more slowly. The mean of the map is subtracted first. The part
//! of the map above f_c stays on the valid pixels and makes a step at their edge.
//!
//! The continuation into the margin is smooth, at the cost of hundreds of Fourier transforms. Use it for
//! the inverse filters, which amplify kinks at the edge, with f_c about 1 / (2 FWHM) of the tool. The map
//! is continued periodically: give a margin of at least 1 / (2 f_c), so that the opposite edge does not
//! matter.
//!
//! Source: R. W. Gerchberg, Opt. Acta 21 (1974) 709; A. Papoulis, IEEE Trans. Circuits Syst. 22
//! (1975) 735, Eqs 3-6.

use ndarray::{Array2, Zip, s};
use planish_numerics::{fft::smooth_size, fft::transform};
use planish_types::{Grid, Invalid, progress};
use serde::Serialize;
use serde_json::{Value, json};

use super::nearest;

/// Largest number of steps that a caller may ask for. Larger: a mistyped number takes longer. Smaller:
/// refuses long but useful runs. Chosen: after the first hundreds of steps the change is below what any
/// measurement resolves.
const MOST_ITERATIONS: usize = 100_000;

/// Cutoff of the spatial frequencies, and the rule that ends the steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GerchbergPapoulisSettings {
    /// Cutoff frequency (f_c of the module), 1/mm; at least that of one wave over the enlarged map, and at most 1 / (2
    /// step) for the larger step of the pixels.
    pub cutoff_per_mm: f64,
    /// Largest number of steps; each takes two Fourier transforms.
    pub max_iterations: usize,
    /// Largest change of a height in a step, nm, at or below which the steps end; >= 0.
    pub tolerance_nm: f64,
}

impl GerchbergPapoulisSettings {
    /// Returns the settings with this cutoff, 1/mm, and the default rule that ends the steps.
    pub fn for_cutoff_per_mm(cutoff_per_mm: f64) -> Self {
        Self { cutoff_per_mm, max_iterations: 300, tolerance_nm: 1e-3 }
    }
}

/// Returns `map` (ny, nx), which is enlarged by the margin already, with a height on every pixel, and numbers for the
/// report. Refuses settings out of their range.
pub(super) fn extend(
    map: &Array2<f64>,
    grid: &Grid,
    settings: &GerchbergPapoulisSettings,
) -> Result<(Array2<f64>, Value), Invalid> {
    let (ny, nx) = map.dim();
    // The transform's own margin, for its speed, joins the unknown pixels.
    let size = (smooth_size(ny), smooth_size(nx));
    settings.check(grid, size)?;
    let mut known = Array2::from_elem(size, f64::NAN);
    known.slice_mut(s![..ny, ..nx]).assign(map);
    let valid: Vec<f64> = known.iter().copied().filter(|v| !v.is_nan()).collect();
    let mean = valid.iter().sum::<f64>() / valid.len() as f64;
    known -= mean;

    let pass = Array2::from_shape_fn(size, |(k, l)| {
        let fy = transform::frequency(k, size.0) / grid.y.step_mm();
        let fx = transform::frequency(l, size.1) / grid.x.step_mm();
        fx.hypot(fy) <= settings.cutoff_per_mm
    });
    let mut z = nearest::extend(&known, grid);
    let mut iterations = 0;
    let mut change = 0.0;
    while iterations < settings.max_iterations {
        // L z_k
        let mut spectrum = transform::forward(z.view());
        Zip::from(&mut spectrum).and(&pass).for_each(|v, pass| *v *= f64::from(u8::from(*pass)));
        let low = transform::inverse(spectrum);
        change = 0.0;
        Zip::from(&mut z).and(&low).and(&known).for_each(|z, low, known| {
            if known.is_nan() {
                change = f64::max(change, (*low - *z).abs());
                *z = *low;
            }
        });
        iterations += 1;
        progress::done(iterations as f64 / settings.max_iterations as f64);
        if change <= settings.tolerance_nm {
            break;
        }
    }
    let own = json!({
        "iterations": iterations,
        "last_change_nm": change,
        "stopped_by": if change <= settings.tolerance_nm { "tolerance" } else { "max_iterations" },
    });
    Ok((z.slice_move(s![..ny, ..nx]) + mean, own))
}

impl GerchbergPapoulisSettings {
    fn check(&self, grid: &Grid, size: (usize, usize)) -> Result<(), Invalid> {
        let [dx, dy] = [grid.x, grid.y].map(|axis| axis.step_mm());
        let f = self.cutoff_per_mm;
        let highest = 0.5 / dx.max(dy);
        if !(f > 0.0 && f <= highest) {
            return Err(Invalid::whole(
                "extension cutoff",
                format!("is {f} /mm"),
                format!("give a spatial frequency up to {highest} /mm; 1 / (2 FWHM) is usual"),
            ));
        }
        let lowest = (1.0 / (dx * size.1 as f64)).min(1.0 / (dy * size.0 as f64));
        if f < lowest {
            return Err(Invalid::whole(
                "extension cutoff",
                format!("of {f} /mm leaves no wave in the map"),
                format!("give at least {lowest} /mm"),
            ));
        }
        if self.max_iterations > MOST_ITERATIONS {
            let problem = format!("are {}", self.max_iterations);
            let remedy = format!("give at most {MOST_ITERATIONS}; 300 are usual");
            return Err(Invalid::whole("extension iterations", problem, remedy));
        }
        if !(self.tolerance_nm.is_finite() && self.tolerance_nm >= 0.0) {
            let problem = format!("is {} nm", self.tolerance_nm);
            return Err(Invalid::whole("extension tolerance", problem, "give at least 0 nm"));
        }
        Ok(())
    }
}
