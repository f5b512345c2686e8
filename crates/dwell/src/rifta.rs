//! Robust iterative Fourier transform algorithm: an inverse filter with an optimised threshold.
//!
//! ```text
//! tau = max(0, IFFT(G Z)),   G = 1 / R where |R| > 1 / gamma,  gamma conj(R) / |R| elsewhere   (1)
//! ```
//!
//! with the spectra Z of the extended desired removal and R of the TIF. gamma (s/nm) caps the gain: it is searched for
//! the least RMS of the residual in the aperture. *Lattice* is that of the tool positions. Two loops around (1):
//!
//! * *piston*: tau is cut at zero, so more is removed than desired somewhere; the desired removal is raised (*lifted*)
//!   by the largest excess, until the RMS changes no more;
//! * *margin*: dwell times reach beyond the aperture by the half size of the TIF at most; of some smaller margins, the
//!   smallest is taken that costs less time and hardly any residual.
//!
//! The dwell map then goes to the path (`dwell_map.rs`). The unknowns are on the pixels of the map, so the pitch of the
//! path must be fine against the TIF. A TIF that is not around the origin of its offsets is centred first
//! ([`planish_types::Tif::centred_on`]), so that margin and half size are those of the removal. The map is continued
//! beyond the aperture by `extension.rs`, and falls to zero beyond the reach of the margin.
//!
//! Source: T. Wang et al., Sci. Rep. 10 (2020) 8135, with the search in one dimension (theirs is a
//! simplex) and the floor in the model.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | Z | `lifted` | extended map | nm |
//! | tau | `seconds` | lattice | s |
//! | gamma | `gamma` | - | s/nm |

use std::f64::consts::PI;

use ndarray::{Array2, Zip};
use planish_numerics::fft::Complex64;
use planish_types::{Axis, End, Grid, Invalid, progress};
use serde::Serialize;

use crate::{
    DwellError,
    dwell_map::{DwellMap, NodeOwners},
    extension::Extension,
    lucy_richardson::counts,
    problem::{DwellModel, Problem, Solution, check},
};

/// Settings of the robust iterative Fourier transform algorithm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RiftaSettings {
    /// Increase of the residual RMS, over that with the margin of the TIF, below which a smaller margin is still taken,
    /// nm; >= 0.
    pub margin_tolerance_nm: f64,
    /// Change of the residual RMS below which the lifts of the map end, nm; > 0.
    pub piston_tolerance_nm: f64,
    /// Largest number of lifts of the map by a piston, for each margin.
    pub max_lifts: usize,
    /// Fraction of the pixels, the lowest ones, that do not decide how much is removed; in [0, 1).
    pub pits: f64,
}

impl Default for RiftaSettings {
    fn default() -> Self {
        // Those of the source, where the lowest pixel decides.
        Self { margin_tolerance_nm: 0.02, piston_tolerance_nm: 1e-3, max_lifts: 10, pits: 1e-3 }
    }
}

/// Report of the robust iterative Fourier transform algorithm.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RiftaReport {
    /// Reason for which the lifts of the map ended: `settled` (another lift would lower the RMS by little or not at
    /// all), or `lift-limit`.
    pub end: End,
    /// Cap gamma of the gain, times the sum of the TIF at the pitch of the map; 1 is the gain for a constant.
    pub relative_gamma: f64,
    /// Lift of the map by a piston, nm.
    pub piston_nm: f64,
    /// Margin of the dwell times beyond the aperture, mm.
    pub margin_mm: f64,
    /// Margins that were tried, mm.
    pub tried_margin_mm: Vec<f64>,
    /// RMS of the residual of the dwell map, before its transfer to the path, for every margin that was tried, nm.
    pub tried_rms_nm: Vec<f64>,
    /// Total time of the dwell map for every margin that was tried, s.
    pub tried_time_s: Vec<f64>,
    /// RMS of the residual of the dwell map, before its transfer to the path, nm.
    pub map_rms_nm: f64,
}

impl RiftaReport {
    /// Returns the reason of a negative verdict; none if the lifts settled.
    pub fn negative(&self) -> Option<String> {
        if self.end != End::LiftLimit {
            return None;
        }
        let reason = "not settled: every lift of the map that is allowed was taken, and another would lower the RMS";
        Some(reason.to_string())
    }
}

/// Finds the dwell times by the inverse filter (1) of the module. Its margin is the half size of the TIF, or the
/// smallest of some smaller ones that costs less time and raises the residual RMS by less than `margin_tolerance_nm`.
///
/// # Errors
/// Refuses settings out of range, and a TIF that varies over the part, is larger than the map along x or y, or has no
/// positive sum at the pitch of the map. Every solver refuses weights and floors out of range, a floor that alone
/// removes more than the PV of the map, a TIF that varies in time, and a tool that does not reach the map.
pub fn solve(
    problem: &Problem<'_>,
    settings: &RiftaSettings,
) -> Result<Solution<RiftaReport>, DwellError> {
    let RiftaSettings { margin_tolerance_nm, piston_tolerance_nm, .. } = *settings;
    check("margin_tolerance_nm", margin_tolerance_nm, |t| t >= 0.0, "give a number >= 0")?;
    check("piston_tolerance_nm", piston_tolerance_nm, |t| t > 0.0, "give a number > 0")?;
    check("pits", settings.pits, |p| (0.0..1.0).contains(&p), "give a fraction from 0 to below 1")?;
    problem.tif.same_everywhere("rifta")?;
    refuse_a_tif_larger_than_the_map(problem)?;
    let centred = problem.tif.centred_on(problem.desired)?;
    let problem = &problem.with(centred.as_ref());
    let model = DwellModel::for_map(problem)?;
    let fourier = Fourier::new(&model, settings.pits)?;
    if !(fourier.map.rate_sum > 0.0 && fourier.map.rate_sum.is_finite()) {
        let Grid { x, y } = problem.tif.grid();
        return Err(Invalid::whole(
            "rate_nm_per_s",
            format!("of {} x {} samples has no sum on the pixels of the map", x.len(), y.len()),
            "check that the TIF and the map are both in mm, and bin the finer one",
        )
        .into());
    }
    // Reference: the margin of the TIF; then smaller ones, from a third of it.
    let radius_mm = fourier.radius_mm;
    let reference = progress::part(0, 1 + MARGINS_TRIED, || fourier.solve(radius_mm, settings));
    let mut best = 0;
    let mut tried = vec![reference];
    for k in 0..MARGINS_TRIED {
        let fraction = 1.0 / 3.0 + 2.0 / 3.0 * k as f64 / MARGINS_TRIED as f64;
        tried.push(progress::part(1 + k, 1 + MARGINS_TRIED, || {
            fourier.solve(fraction * radius_mm, settings)
        }));
        let last = &tried[1 + k];
        if last.time_s < tried[0].time_s && last.rms_nm - tried[0].rms_nm < margin_tolerance_nm {
            best = 1 + k;
            break;
        }
    }
    let best = &tried[best];
    let t = fourier.cells.to_path(&best.seconds, problem.path.len());
    let report = RiftaReport {
        end: if best.settled { End::Settled } else { End::LiftLimit },
        relative_gamma: best.gamma * fourier.map.rate_sum,
        piston_nm: best.piston_nm,
        margin_mm: best.margin_mm,
        tried_margin_mm: tried.iter().map(|d| d.margin_mm).collect(),
        tried_rms_nm: tried.iter().map(|d| d.rms_nm).collect(),
        tried_time_s: tried.iter().map(|d| d.time_s).collect(),
        map_rms_nm: best.rms_nm,
    };
    model.finish(model.lo.iter().zip(t).map(|(lo, t)| lo + t).collect(), report)
}

/// Number of margins that are tried besides that of the TIF; all are smaller. Larger: more time, and a finer choice.
/// Smaller: the best margin may lie between two trials.
const MARGINS_TRIED: usize = 8;

/// Refuses a TIF larger than the map along x or y: most of the extended map would then be border, which was not
/// measured.
pub(crate) fn refuse_a_tif_larger_than_the_map(problem: &Problem<'_>) -> Result<(), Invalid> {
    let map = problem.desired.grid();
    let tif = problem.tif.grid();
    for (name, map, tif) in [("x_mm", &map.x, &tif.x), ("y_mm", &map.y, &tif.y)] {
        let size = tif.end_mm() - tif.start_mm();
        let limit = map.end_mm() - map.start_mm();
        if size > limit {
            return Err(Invalid::whole(
                name,
                format!("the TIF spans {size:.4} mm, the map {limit:.4} mm"),
                "this solver extends the map by the TIF, which must not be the larger one; use \
                 bounded-least-squares",
            ));
        }
    }
    Ok(())
}

/// The extended map, and everything that stays the same from one margin to the next.
struct Fourier<'a> {
    model: &'a DwellModel<'a>,
    map: DwellMap,
    cells: NodeOwners,
    extension: Extension,
    /// Desired removal minus the removal by the floor and minus its lowest value in the aperture without the pits,
    /// continued over the extended map, nm.
    target: Array2<f64>,
    taper: Array2<f64>,
    /// Distance of every node of the lattice from the aperture, mm; 0 inside, infinite for nodes far from every dwell
    /// point.
    distance_mm: Array2<f64>,
    /// Half size of the TIF, the larger one of x and y, mm.
    radius_mm: f64,
}

/// The dwell map for one margin, s, and the RMS of its residual.
struct MarginTrial {
    seconds: Array2<f64>,
    gamma: f64,
    piston_nm: f64,
    margin_mm: f64,
    rms_nm: f64,
    time_s: f64,
    /// True if the lifts ended because another would lower the RMS by little or not at all. False if their largest
    /// number ended them.
    settled: bool,
}

impl<'a> Fourier<'a> {
    fn new(model: &'a DwellModel<'a>, pits: f64) -> Result<Self, DwellError> {
        let Problem { desired, tif, path, .. } = model.problem;
        let [half_x, half_y] = tif.half_size_mm();
        let radius_mm = half_x.max(half_y);
        let step = desired.grid().x.step_mm().min(desired.grid().y.step_mm());
        // Tools in the margin reach another half size; then room for the way down to zero.
        let border = (2.5 * radius_mm / step).ceil() as usize;
        let valid = model.weight.mapv(|w| w > 0.0);
        let extension = Extension::new(desired.grid(), &valid, [border; 2], radius_mm)?;
        let target = model.target();
        let low = model.lowest(&target, pits);
        let target = extension.rise(&target.mapv(|z| z - low));
        let taper = Array2::from_shape_fn(target.dim(), |p| {
            let beyond = (extension.distance_mm(p) / radius_mm - 1.5).clamp(0.0, 1.0);
            0.5 * (1.0 + (PI * beyond).cos())
        });
        let map = DwellMap::new(tif, &extension.grid)?;
        let cells = NodeOwners::new(path, &map.grid, |p| counts(desired, &model.weight, p));
        let owned = cells.owned();
        let distance_mm = Array2::from_shape_fn(map.grid.shape(), |(r, c)| {
            let row = nearest_index(&extension.grid.y, map.grid.y.coordinate_mm(r));
            let p = (row, nearest_index(&extension.grid.x, map.grid.x.coordinate_mm(c)));
            // No path, no dwell.
            if owned[[r, c]] { extension.distance_mm(p) } else { f64::INFINITY }
        });
        Ok(Self { model, map, cells, extension, target, taper, distance_mm, radius_mm })
    }

    /// Returns the dwell map (1) of the module within the margin, s, its residual on the pixels of the map, nm, and the
    /// RMS of the residual. For the dwell map, the desired removal is raised by `piston_nm`.
    fn apply(&self, piston_nm: f64, gamma: f64, margin_mm: f64) -> (Array2<f64>, Array2<f64>, f64) {
        let lifted = (&self.target + piston_nm) * &self.taper;
        let mut seconds = self.map.filtered(&lifted, |r| {
            let size = r.norm();
            if size * gamma > 1.0 {
                r.inv()
            } else if size > 0.0 {
                r.conj() * (gamma / size)
            } else {
                Complex64::default()
            }
        });
        Zip::from(&mut seconds).and(&self.distance_mm).for_each(|t, d| {
            *t = if *d <= margin_mm { t.max(0.0) } else { 0.0 };
        });
        let residual = self.extension.inner(&(&self.target - &self.map.removal(seconds.view())));
        let rms = self.model.rms(&residual);
        (seconds, residual, rms)
    }

    /// Finds the dwell map for one margin: lifts the map until the RMS of the residual settles.
    fn solve(&self, margin_mm: f64, settings: &RiftaSettings) -> MarginTrial {
        let gamma = self.gamma(margin_mm);
        let mut piston_nm = 0.0;
        let (mut seconds, mut residual, mut rms) = self.apply(piston_nm, gamma, margin_mm);
        let mut settled = false;
        for _ in 0..settings.max_lifts {
            // Lift by the largest excess of the removal.
            let excess = (-self.model.lowest(&residual, settings.pits)).max(0.0);
            let before = rms;
            let next = self.apply(excess, gamma, margin_mm);
            if next.2 > before {
                settled = true;
                break;
            }
            piston_nm = excess;
            (seconds, residual, rms) = next;
            if before - rms < settings.piston_tolerance_nm {
                settled = true;
                break;
            }
        }
        let time_s = seconds.sum();
        MarginTrial { time_s, seconds, gamma, piston_nm, margin_mm, rms_nm: rms, settled }
    }

    /// Returns the cap gamma of the gain with the least RMS for a margin, s/nm: a scan over three decades, then the
    /// golden section.
    fn gamma(&self, margin_mm: f64) -> f64 {
        let unit = 1.0 / self.map.rate_sum;
        let scan: Vec<f64> =
            (0..=CAPS_SCANNED).map(|k| self.rms_of_cap(ln_cap(k), margin_mm)).collect();
        let k = (0..=CAPS_SCANNED).min_by(|a, b| scan[*a].total_cmp(&scan[*b])).unwrap_or(0);
        let mut low = ln_cap(k.saturating_sub(1));
        let mut high = ln_cap((k + 1).min(CAPS_SCANNED));
        let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
        let mut a = high - golden * (high - low);
        let mut b = low + golden * (high - low);
        let mut rms_a = self.rms_of_cap(a, margin_mm);
        let mut rms_b = self.rms_of_cap(b, margin_mm);
        for _ in 0..10 {
            if rms_a < rms_b {
                (high, b, rms_b) = (b, a, rms_a);
                a = high - golden * (high - low);
                rms_a = self.rms_of_cap(a, margin_mm);
            } else {
                (low, a, rms_a) = (a, b, rms_b);
                b = low + golden * (high - low);
                rms_b = self.rms_of_cap(b, margin_mm);
            }
        }
        let (narrowed, rms) = if rms_a < rms_b { (a, rms_a) } else { (b, rms_b) };
        // The scan may have met a lower valley than the one that was narrowed down.
        unit * if rms < scan[k] { narrowed } else { ln_cap(k) }.exp()
    }

    /// Returns the RMS of the residual for a cap of the gain and a margin, nm, without a lift. The cap is given as the
    /// natural logarithm of gamma over the gain for a constant.
    fn rms_of_cap(&self, ln_cap: f64, margin_mm: f64) -> f64 {
        let unit = 1.0 / self.map.rate_sum;
        self.apply(0.0, unit * ln_cap.exp(), margin_mm).2
    }
}

/// Returns the k-th cap of the scan, as the natural logarithm of gamma over the gain for a constant.
fn ln_cap(k: usize) -> f64 {
    1e3_f64.ln() * k as f64 / CAPS_SCANNED as f64
}

/// Returns the index of the coordinate nearest to p, mm; for a p beyond the axis, that of its nearer end.
fn nearest_index(axis: &Axis, p: f64) -> usize {
    let i = ((p - axis.start_mm()) / axis.step_mm()).round();
    i.clamp(0.0, (axis.len() - 1) as f64) as usize
}

/// Number of intervals of the scan of the cap over a factor of 1000, before the best cap is narrowed down; neighbours
/// differ by a factor of about 2.4. Larger: more time. Smaller: the scan may miss the lowest valley.
const CAPS_SCANNED: usize = 8;
