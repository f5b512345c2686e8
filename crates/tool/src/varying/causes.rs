//! The tools of [`crate::varying`] as functions of the place, the position [x, y] of the tool on the part.

use ndarray::Array2;
use planish_types::{Axis, Grid, Invalid, Pose, Tif};
use rayon::prelude::*;
use serde::Serialize;

use super::{
    low_rank::LocalTool,
    place::{Parameter, Places},
};

/// Returns the samples of `tif` with the tool at `tool_mm`, nm/s, on the offsets of the TIF. A tool that turns with its
/// motion is taken in motion along x.
pub fn tool_at(tif: &Tif, tool_mm: [f64; 2]) -> Array2<f64> {
    tif.variation()
        .map_or_else(|| tif.rate_nm_per_s().clone(), |v| v.rate_at(Pose::along_x(tool_mm)))
}

/// Law of the factor of the removal rate, as a function of a parameter of the place, for example the incidence.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RateLaw {
    /// `cos(parameter)^exponent`, the parameter an angle in degrees.
    Cosine {
        /// Exponent; below 0 the rate rises with the angle.
        exponent: f64,
    },
    /// Linear between given pairs, whose parameters ascend; constant beyond the first and the last.
    Table {
        /// Pairs [parameter, factor].
        pairs: Vec<[f64; 2]>,
    },
}

impl RateLaw {
    /// Refuses an exponent that is not finite, and a table that is empty or whose parameters do not ascend.
    pub fn check(&self) -> Result<(), Invalid> {
        match self {
            Self::Cosine { exponent } if !exponent.is_finite() => {
                Err(Invalid::whole("exponent", format!("is {exponent}"), "give a number"))
            }
            Self::Cosine { .. } => Ok(()),
            Self::Table { pairs } => ascending("table", pairs),
        }
    }

    /// Returns the factor of the rate at a value of the parameter (for the cosine: an angle in degrees).
    pub fn factor(&self, parameter: f64) -> f64 {
        match self {
            Self::Cosine { exponent } => parameter.to_radians().cos().powf(*exponent),
            Self::Table { pairs } => {
                let (before, after, f) = between(pairs.len(), parameter, |i| pairs[i][0]);
                (1.0 - f) * pairs[before][1] + f * pairs[after][1]
            }
        }
    }
}

/// Refuses an empty table, and pairs whose first numbers do not ascend; `name` is the setting in the message.
fn ascending(name: &'static str, pairs: &[[f64; 2]]) -> Result<(), Invalid> {
    if pairs.is_empty() {
        return Err(Invalid::whole(
            name,
            "has no rows",
            "give a parameter and a factor in each row",
        ));
    }
    match (1..pairs.len()).find(|i| pairs[*i][0] <= pairs[*i - 1][0]) {
        None => Ok(()),
        Some(i) => {
            let problem = format!("is {} after {}", pairs[i][0], pairs[i - 1][0]);
            Err(Invalid::at_index(name, i, problem, "give ascending parameters"))
        }
    }
}

/// Finds the interval of `count` ascending numbers that contains `value`; `number(i)` is the i-th of them. Returns the
/// indices of its ends and the position between them, 0 to 1; beyond the numbers twice the nearest end.
fn between(count: usize, value: f64, number: impl Fn(usize) -> f64) -> (usize, usize, f64) {
    match (0..count).find(|i| number(*i) > value) {
        Some(0) => (0, 0, 0.0),
        None => (count - 1, count - 1, 0.0),
        Some(after) => {
            let (low, high) = (number(after - 1), number(after));
            (after - 1, after, (value - low) / (high - low))
        }
    }
}

/// Spots measured at several values of a parameter. Between two of them the tool is their linear mixture; beyond the
/// first and the last it is that one.
#[derive(Clone, Debug)]
pub struct Spots {
    offsets: Grid,
    /// Parameter and samples, nm/s, of every spot on `offsets`, by ascending parameter.
    spots: Vec<(f64, Array2<f64>)>,
}

impl Spots {
    /// Resamples the spots, each with its parameter, to the pitch of the first one and to the offsets that at least one
    /// of them covers.
    ///
    /// # Errors
    /// Refuses an empty list, spots that vary over the part, parameters that are not finite, and two spots of one
    /// parameter.
    pub fn new(mut measured: Vec<(f64, Tif)>) -> Result<Self, Invalid> {
        let Some((_, first)) = measured.first() else {
            return Err(Invalid::whole("spot", "is missing", "give at least one spot"));
        };
        let pitch = [first.grid().x.step_mm(), first.grid().y.step_mm()];
        let centre = [first.grid().x.start_mm(), first.grid().y.start_mm()];
        for (parameter, tif) in &measured {
            tif.same_everywhere("a measured spot")?;
            if !parameter.is_finite() {
                let remedy = "give the parameter of the place where it was measured";
                return Err(Invalid::whole(
                    "spot",
                    format!("has the parameter {parameter}"),
                    remedy,
                ));
            }
        }
        measured.sort_by(|a, b| a.0.total_cmp(&b.0));
        if let Some(i) = (1..measured.len()).find(|i| measured[*i].0 == measured[*i - 1].0) {
            let problem = format!("two have the parameter {}", measured[i].0);
            return Err(Invalid::whole("spot", problem, "average them first, or give another one"));
        }
        // Nodes of the first spot, continued as far as the widest one.
        let [x, y] = [0, 1].map(|k| {
            let axes = measured.iter().map(|(_, tif)| [tif.grid().x, tif.grid().y][k]);
            let low = axes.clone().map(|axis| axis.start_mm()).fold(f64::INFINITY, f64::min);
            let high = axes.map(|axis| axis.end_mm()).fold(f64::NEG_INFINITY, f64::max);
            let before = ((centre[k] - low) / pitch[k] - 1e-6).ceil().max(0.0);
            let start = centre[k] - before * pitch[k];
            let count = ((high - start) / pitch[k] - 1e-6).ceil() as usize + 1;
            Axis::new(start, pitch[k], count)
        });
        let offsets = Grid { x: x?, y: y? };
        let spots = measured.iter().map(|(parameter, tif)| {
            let samples = Array2::from_shape_fn(offsets.shape(), |(r, c)| {
                tif.rate_at(offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r))
            });
            (*parameter, samples)
        });
        Ok(Self { offsets, spots: spots.collect() })
    }

    /// Returns the grid of the offsets of the samples from the tool, mm.
    pub fn offsets(&self) -> Grid {
        self.offsets
    }

    /// Returns the samples of the tool at a value of the parameter, nm/s, shape (ny, nx) of the offsets.
    pub fn tool(&self, parameter: f64) -> Array2<f64> {
        let (before, after, f) = between(self.spots.len(), parameter, |i| self.spots[i].0);
        &self.spots[before].1 * (1.0 - f) + &self.spots[after].1 * f
    }
}

/// Law of the pressure under a pad that hangs over the edge, with the same force as on the part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum PressureLaw {
    /// The same pressure on all of the covered area: the whole area over the covered one.
    Uniform,
    /// Linear in the offset, in equilibrium of force and moments about the centre of the pad, and nowhere negative.
    Linear,
}

/// A pad that hangs over the edge of the part: `K(u; p) = R(u) q(u; p)`, q the pressure over that of a pad that is
/// covered.
///
/// With the covered part C of the area A of the pad,
///
/// ```text
/// uniform    q = |A| / |C|
/// linear     q = max(c0 + c . u, 0),   integral over C of q = |A|,   integral over C of q u = 0          (1)
/// ```
///
/// The linear law is the equilibrium of a rigid pad. Measured edge functions, and a parametric model of them, are in D.
/// W. Kim et al., Opt. Express 17 (2009) 5656; they can be given as [`Spots`].
#[derive(Debug)]
pub struct Overhang<'a> {
    tif: &'a Tif,
    places: &'a Places<'a>,
    law: PressureLaw,
    radius_mm: f64,
    /// Offsets of the points of the pad from its centre, mm.
    pad_mm: Vec<[f64; 2]>,
    /// Positions of the tool at which enough of the pad is covered, mm: only the middle of the part if it is one of
    /// them, otherwise many positions over the part.
    covered_mm: Vec<[f64; 2]>,
}

/// Smallest covered fraction of the pad for which the uniform law is used. A tool farther outside gets the pressure at
/// the nearest position, towards the middle of the part or the nearest covered one, with this fraction. Larger: pads
/// that hang over far have too little pressure. Smaller: the pressure grows without bound where nobody works.
const LEAST_COVERED_UNIFORM: f64 = 0.4;

/// Smallest covered fraction of the pad for which the linear law is used. A straight edge leaves 0.7 where a third of
/// the diameter hangs over. Farther outside the pad tilts off the part, and no linear pressure without a negative part
/// is in equilibrium.
const LEAST_COVERED_LINEAR: f64 = 0.6;

/// Width of the range of the covered fraction in which the pressure passes smoothly to a constant, about the smallest
/// fraction. Larger: pressures that are too small where the law still holds. Smaller: a kink of the pressure along the
/// edge, which weights on a lattice miss. Chosen: the law holds as it is where a third of the diameter hangs over a
/// straight edge. A ring of 300 mm with a hole of 60 mm and a pad of 40 mm has an error of 0.0055 (0.0228 without the
/// range, 0.0103 with 0.1).
const LEVELLED_OFF: f64 = 0.2;

/// Distance between the positions among which the nearest covered one is searched, as a fraction of the radius of the
/// pad. Larger: a direction towards the part that is less exact. Smaller: more time.
const SEARCHED_OVER_RADIUS: f64 = 0.125;

/// Largest number of positions among which the nearest covered one is searched. Larger: more time for small pads on
/// large parts. Smaller: larger distances between them.
const MOST_SEARCHED: f64 = 20_000.0;

/// Number of halvings that find the first position at which enough of the pad is covered: to 1e-4 of the distance to
/// the nearest covered one. Larger: more time. Smaller: a step in the pressure.
const HALVINGS: usize = 14;

/// Number of points along the diameter of the pad. Larger: more time. Smaller: the covered area is less exact.
const POINTS_OF_PAD: usize = 61;

impl<'a> Overhang<'a> {
    /// Makes a round pad of the radius `pad_radius_mm`, whose removal is `tif` where all of it is on the part.
    ///
    /// # Errors
    /// Refuses a TIF that varies over the part, and a pad that is smaller than a sample or nowhere covered enough.
    pub fn new(
        tif: &'a Tif,
        places: &'a Places<'a>,
        law: PressureLaw,
        pad_radius_mm: f64,
    ) -> Result<Self, Invalid> {
        tif.same_everywhere("a pad that hangs over the edge")?;
        let Grid { x, y } = tif.grid();
        let sample_mm = x.step_mm().min(y.step_mm());
        if !(pad_radius_mm.is_finite() && pad_radius_mm >= sample_mm) {
            let problem = format!(
                "is {pad_radius_mm}, where the samples of the TIF are {sample_mm} mm apart"
            );
            let remedy = "give the radius of the pad in mm, not less than this distance";
            return Err(Invalid::whole("pad_radius_mm", problem, remedy));
        }
        let all = (0..POINTS_OF_PAD).flat_map(|r| (0..POINTS_OF_PAD).map(move |c| [c, r]));
        let all = all.map(|point| {
            point.map(|k| (2.0 * (k as f64 + 0.5) / POINTS_OF_PAD as f64 - 1.0) * pad_radius_mm)
        });
        let pad_mm = all.filter(|[x, y]| x.hypot(*y) <= pad_radius_mm).collect();
        let radius_mm = pad_radius_mm;
        let mut pad = Self { tif, places, law, radius_mm, pad_mm, covered_mm: Vec::new() };
        let area_mm2 = places.valid_mm2();
        let apart_mm =
            (SEARCHED_OVER_RADIUS * pad_radius_mm).max((area_mm2 / MOST_SEARCHED).sqrt());
        let all = places.valid_places(apart_mm);
        // Towards the middle the tool changes least beyond the edge; where the part has a hole there, no pad is
        // covered. On a narrow part the pressure may level off nowhere.
        let middle = places.middle_mm();
        for least in [pad.least_covered() + 0.5 * LEVELLED_OFF, pad.least_covered()] {
            pad.covered_mm = if pad.is_covered(middle, least) {
                vec![middle]
            } else {
                all.par_iter().copied().filter(|p| pad.is_covered(*p, least)).collect()
            };
            if !pad.covered_mm.is_empty() {
                break;
            }
        }
        if pad.covered_mm.is_empty() {
            let problem = format!(
                "is {pad_radius_mm} mm, and nowhere {} % of such a pad is on the part",
                100.0 * pad.least_covered()
            );
            let remedy = "give the radius of the pad in mm; a part that is narrower than its pad needs spots that were \
                          measured there (planish tool spots)";
            return Err(Invalid::whole("pad_radius_mm", problem, remedy));
        }
        Ok(pad)
    }

    /// Returns the smallest covered fraction of the pad for which its law is used.
    fn least_covered(&self) -> f64 {
        match self.law {
            PressureLaw::Uniform => LEAST_COVERED_UNIFORM,
            PressureLaw::Linear => LEAST_COVERED_LINEAR,
        }
    }

    /// Returns the offsets of the points of the pad, mm, and the fraction (0 to 1) of each that lies on the part if the
    /// tool is at `p`.
    fn points(&self, p: [f64; 2]) -> impl Iterator<Item = ([f64; 2], f64)> {
        self.pad_mm.iter().map(move |u| (*u, self.places.covered([p[0] + u[0], p[1] + u[1]])))
    }

    /// Returns the fraction of the pad, 0 to 1, that lies on the part, for a tool at `p`, mm.
    pub fn covered(&self, p: [f64; 2]) -> f64 {
        self.points(p).map(|(_, part)| part).sum::<f64>() / self.pad_mm.len() as f64
    }

    /// Returns true if the whole pad is on the part and false if nothing of it is, from the distance of `p` to the
    /// edge. `None` if the edge may be under the pad.
    fn beside_edge(&self, p: [f64; 2]) -> Option<bool> {
        let far_mm = self.radius_mm + 2.0 * self.places.pixel_mm();
        let distance_mm = self.places.parameter(Parameter::EdgeDistance, p).ok()?;
        if distance_mm.abs() > far_mm { Some(distance_mm > 0.0) } else { None }
    }

    /// Returns true if enough of the pad is on the part for its law to be used, for a tool at `p`, mm.
    pub fn is_used(&self, p: [f64; 2]) -> bool {
        self.is_covered(p, self.least_covered())
    }

    /// Returns true if at least the fraction `least` of the pad is on the part, for a tool at `p`, mm.
    fn is_covered(&self, p: [f64; 2], least: f64) -> bool {
        self.beside_edge(p).unwrap_or_else(|| self.covered(p) >= least)
    }

    /// Returns the covered fraction for which the pressure is computed: `covered` itself, or near and below the
    /// smallest allowed fraction a larger one that passes smoothly to it.
    fn levelled_off(&self, covered: f64) -> f64 {
        let least = self.least_covered();
        let below = least + 0.5 * LEVELLED_OFF - covered;
        if below <= 0.0 {
            covered
        } else if below >= LEVELLED_OFF {
            least
        } else {
            covered + below * below / (2.0 * LEVELLED_OFF)
        }
    }

    /// Returns `p` itself if its covered fraction is that for which the pressure is computed. Otherwise it returns the
    /// first position with that fraction on the line to the nearest of `covered_mm`.
    fn covered_enough(&self, p: [f64; 2]) -> [f64; 2] {
        let covered = self.covered(p);
        if covered >= self.levelled_off(covered) {
            return p;
        }
        let inside = nearest(&self.covered_mm, p)
            .expect("the constructor refuses a pad without such places");
        let least = self.levelled_off(covered).min(self.covered(inside));
        let towards = |s: f64| [0, 1].map(|k| p[k] + s * (inside[k] - p[k]));
        let mut low = 0.0;
        let mut high = 1.0;
        for _ in 0..HALVINGS {
            let s = 0.5 * (low + high);
            if self.covered(towards(s)) >= least { high = s } else { low = s }
        }
        towards(high)
    }

    /// Returns the samples of the tool at `p` (mm), nm/s, on the offsets of its TIF. The pressure factor multiplies all
    /// samples, also those beyond the edge.
    pub fn tool(&self, p: [f64; 2]) -> Array2<f64> {
        let rate = self.tif.rate_nm_per_s();
        if self.beside_edge(p) == Some(true) {
            return rate.clone();
        }
        let p = self.covered_enough(p);
        let uniform = [1.0 / self.covered(p), 0.0, 0.0];
        let [c0, cx, cy] = match self.law {
            PressureLaw::Uniform => uniform,
            PressureLaw::Linear => self.linear(p).unwrap_or(uniform),
        };
        let grid = self.tif.grid();
        Array2::from_shape_fn(rate.dim(), |(r, c)| {
            let pressure =
                (c0 + cx * grid.x.coordinate_mm(c) + cy * grid.y.coordinate_mm(r)).max(0.0);
            rate[[r, c]] * pressure
        })
    }

    /// Returns c0 and the components of c of the linear law (1), without its maximum; `None` if the covered points lie
    /// on a line.
    fn linear(&self, p: [f64; 2]) -> Option<[f64; 3]> {
        let mut moments = nalgebra::Matrix3::zeros();
        for ([x, y], part) in self.points(p).filter(|(_, part)| *part > 0.0) {
            let u = nalgebra::Vector3::new(1.0, x, y);
            moments += part * u * u.transpose();
        }
        let all = self.pad_mm.len() as f64;
        let solution = moments.lu().solve(&nalgebra::Vector3::new(all, 0.0, 0.0))?;
        Some([solution[0], solution[1], solution[2]])
    }
}

/// Returns the one of `places` that is nearest to (x, y); `None` if there is none.
fn nearest(places: &[[f64; 2]], [x, y]: [f64; 2]) -> Option<[f64; 2]> {
    let squares = places.iter().map(|q| ((q[0] - x).powi(2) + (q[1] - y).powi(2), *q));
    squares.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, place)| place)
}

/// Makes a spot that turns about its centre with the azimuth of its place about `middle_mm`; at the azimuth 0 (towards
/// positive x) it is `tif`. Returns the offsets, which hold the spot in every direction, and the tool as a function of
/// its place. Refuses a TIF that varies over the part.
pub fn turned(tif: &Tif, middle_mm: [f64; 2]) -> Result<(Grid, Box<LocalTool<'static>>), Invalid> {
    tif.same_everywhere("a spot that turns")?;
    let spot = tif.without_zero_margins().into_owned();
    let [x, y] = spot.half_size_mm();
    let step = spot.grid().x.step_mm().min(spot.grid().y.step_mm());
    let half = (x.hypot(y) / step).ceil() as usize;
    let axis = Axis::new(-(half as f64) * step, step, 2 * half + 1)?;
    let offsets = Grid { x: axis, y: axis };
    let local_tool = move |p: [f64; 2]| {
        // K(u; p) = R(T(-azimuth) u)
        let (dx, dy) = (p[0] - middle_mm[0], p[1] - middle_mm[1]);
        let radius = dx.hypot(dy);
        let (cosine, sine) = if radius > 0.0 { (dx / radius, dy / radius) } else { (1.0, 0.0) };
        Array2::from_shape_fn(offsets.shape(), |(r, c)| {
            let (x, y) = (offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r));
            spot.rate_at(cosine * x + sine * y, cosine * y - sine * x)
        })
    };
    Ok((offsets, Box::new(local_tool)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::varying::{LowRankSettings, low_rank};
    use planish_types::Surface;

    /// Returns the map of a ring between the radius of its hole and its outer radius, mm, on square pixels.
    fn ring([hole_mm, outer_mm]: [f64; 2], pixel_mm: f64) -> Surface {
        let half = (outer_mm / pixel_mm).round();
        let axis = Axis::new(-half * pixel_mm, pixel_mm, 2 * half as usize + 1).unwrap();
        let height = Array2::from_shape_fn((axis.len(), axis.len()), |(r, c)| {
            let radius_mm = axis.coordinate_mm(r).hypot(axis.coordinate_mm(c));
            if (hole_mm..=outer_mm).contains(&radius_mm) { 100.0 } else { f64::NAN }
        });
        Surface::new(Grid { x: axis, y: axis }, height).unwrap()
    }

    #[test]
    fn a_pad_beside_a_wide_hole_has_few_kernels_with_the_wanted_error() {
        let part = ring([30.0, 150.0], 2.0);
        let axis = Axis::new(-20.0, 1.0, 41).unwrap();
        let rate = Array2::from_shape_fn((41, 41), |(r, c)| {
            10.0 * (1.0 - (axis.coordinate_mm(r).hypot(axis.coordinate_mm(c)) / 20.0).powi(2))
                .max(0.0)
        });
        let tif = Tif::new(Grid { x: axis, y: axis }, rate).unwrap();
        let places = Places::new(&part);
        let pad = Overhang::new(&tif, &places, PressureLaw::Linear, 20.0).unwrap();
        // A strip over both edges, with the places that the whole ring needs for this error.
        let strip = ([[20.0, -11.0], [160.0, 11.0]], Some(2.65625));
        let settings = LowRankSettings { error: 1e-2, max_rank: 64 };
        let made =
            low_rank(tif.grid(), strip, &|p| pad.tool(p), &|p| pad.is_used(p), &settings).unwrap();
        // With a kink where 60 % are covered it is 0.023, and 0.26 at the worst place.
        assert!(made.report.error < 1e-2, "{:?}", made.report);
        assert!(made.report.largest_error < 0.05, "{:?}", made.report);
        assert_eq!(made.report.negative(), None);
        // Where a third of the diameter hangs over, 70 % are covered beside a straight edge, and 68 % beside this
        // one: the pressure is that of the law, but for 0.2 % of the covered part.
        let covered = pad.covered([150.0 - 20.0 + 40.0 / 3.0, 0.0]);
        assert!((pad.levelled_off(covered) / covered - 1.0).abs() < 2e-3, "{covered}");
    }
}
