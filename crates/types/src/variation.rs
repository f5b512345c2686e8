//! Variation of a tool: how a tool influence function (TIF) differs over the part, and in the course of a run.
//!
//! ```text
//! K(x; p, t) = c(t) g(x) sum_k a_k(p) h_k(heading) phi_k(x - p)                           (1)
//! ```
//!
//! K is the removal rate at the pixel x of a tool at the position p, at the time t of the run. The kernels `phi_k` are
//! samples on one grid of offsets, and their weights `a_k` are samples on a coarse grid of tool positions. `g` is a
//! factor of every pixel, for causes that act where the material is removed. `c` is a factor of the time, for wear and
//! warm-up. `h_k` are periodic samples over the heading, which is the direction of the motion, for tools that turn with
//! it. Without `g`, `c` and `h_k` these are 1. Everything that is linear in the dwell time stays linear.
//!
//! Between their samples, kernels, weights and the factor of the pixels are Keys' cubic convolution
//! ([`planish_numerics::keys`]), and `c` is linear. Beyond the samples, a weight has the value of the nearest point of
//! its grid, and `c` that of the nearest time.
//!
//! A tool that turns with the azimuth of its position changes ever faster towards the axis, and no grid of positions
//! follows it there. The weights of such a tool have a factor by azimuth:
//!
//! ```text
//! a_k(p) = b_k(p) z_k(azimuth of p - m)                                                   (2)
//! ```
//!
//! with the samples `b_k` on the grid of positions, and periodic samples `z_k` around the middle m. At m the azimuth is
//! 0.

use std::borrow::Cow;

use ndarray::Array2;
use planish_numerics::keys;

use crate::{Axis, Grid, Invalid, Tif};

/// Smallest factor of a pixel or of a time. A tool that removes nothing at a position makes it unreachable, and a
/// negative factor adds material. Larger: strong causes are refused. Smaller: mistakes in the units pass.
const LEAST_FACTOR: f64 = 1e-3;

/// Largest factor of a pixel or of a time. Larger: mistakes in the units pass. Smaller: strong causes are refused.
const LARGEST_FACTOR: f64 = 1e3;

/// Factor of the removal rate at every pixel, sampled on a grid of the part: g in (1) of the module.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelFactor {
    /// Grid of the sampled pixels, in coordinates of the part.
    pub grid: Grid,
    /// Factors at the pixels of `grid` (ny, nx), dimensionless.
    pub factor: Array2<f64>,
}

/// Largest distance of an angle from its value in a uniform turn, over the step. Larger: angles that are not uniform
/// pass. Smaller: rounded ones do not.
const OFF_TURN: f64 = 1e-6;

/// Factors of the kernel weights that depend on an angle, a heading or an azimuth: periodic samples over one turn.
#[derive(Clone, Debug, PartialEq)]
pub struct TurnWeights {
    angle_deg: Vec<f64>,
    weights: Vec<Vec<f64>>,
}

impl TurnWeights {
    /// Returns the factors (k, n), dimensionless, of the k kernels at n headings, h of (1) in the module. Headings are
    /// directions of the motion, in degrees from positive x towards positive y, uniform over one turn without its end.
    ///
    /// # Errors
    /// Refuses headings that are not uniform over a turn, and rows that are not n finite factors.
    pub fn by_heading(heading_deg: Vec<f64>, weights: Vec<Vec<f64>>) -> Result<Self, Invalid> {
        Self::new(["heading_deg", "heading_weight"], heading_deg, weights)
    }

    /// Returns the checked factors (k, n) at the angles (n), degrees. The two names are those of the arrays of angles
    /// and factors in messages.
    fn new(
        [angles, factors]: [&'static str; 2],
        angle_deg: Vec<f64>,
        weights: Vec<Vec<f64>>,
    ) -> Result<Self, Invalid> {
        let n = angle_deg.len();
        let step = 360.0 / n as f64;
        let remedy = "give angles that are uniform over one turn, without its end: 0, 1, ... 359";
        if n == 0 {
            return Err(Invalid::whole(angles, "is empty", remedy));
        }
        for (i, angle) in angle_deg.iter().enumerate() {
            let uniform = angle_deg[0] + step * i as f64;
            if (angle - uniform).abs() > OFF_TURN * step || angle.is_nan() {
                let problem = format!("is {angle} of {n} angles");
                return Err(Invalid::at_index(angles, i, problem, remedy));
            }
        }
        for (k, row) in weights.iter().enumerate() {
            if row.len() != n {
                let problem = format!("has {} factors for {n} angles", row.len());
                return Err(Invalid::at_index(factors, k, problem, "give one for each angle"));
            }
            if let Some(i) = row.iter().position(|v| !v.is_finite()) {
                let problem = format!("is {}", row[i]);
                return Err(Invalid::at_index(factors, [k, i], problem, "give finite numbers"));
            }
        }
        Ok(Self { angle_deg, weights })
    }

    /// Returns the angles at which the factors are sampled (n), degrees.
    pub fn angle_deg(&self) -> &[f64] {
        &self.angle_deg
    }

    /// Returns the factors (k, n), dimensionless: one row per kernel, one column per angle.
    pub fn weights(&self) -> &[Vec<f64>] {
        &self.weights
    }

    /// Returns the factor of the kernel with the index `kernel` at an angle, by Keys' interpolation of its periodic
    /// samples.
    fn factor_of(&self, kernel: usize, angle_rad: f64) -> f64 {
        let row = &self.weights[kernel];
        let n = row.len() as isize;
        let turns = (angle_rad.to_degrees() - self.angle_deg[0]) / 360.0;
        let (cell, f) = keys::split(turns * n as f64);
        let nodes = (cell - 1..).map(|node| row[node.rem_euclid(n) as usize]);
        keys::weights(f).iter().zip(nodes).map(|(w, sample)| w * sample).sum()
    }

    /// Refuses factors that do not have one row for each of `kernels` kernels. `name` names them in the message.
    fn check_kernels(&self, name: &'static str, kernels: usize) -> Result<(), Invalid> {
        let rows = self.weights.len();
        if rows == kernels {
            return Ok(());
        }
        let problem = format!("has {rows} rows for {kernels} kernels");
        Err(Invalid::whole(name, problem, "give a row for each kernel"))
    }
}

/// Factors of the kernel weights that depend on the azimuth of the tool position: z in (2) of the module.
#[derive(Clone, Debug, PartialEq)]
pub struct AzimuthWeights {
    middle_mm: [f64; 2],
    turn: TurnWeights,
}

impl AzimuthWeights {
    /// Returns the factors (k, n), dimensionless, of the k kernels at n azimuths about the point `middle_mm` [x, y].
    /// The azimuths, in degrees from positive x towards positive y, are uniform over one turn without its end.
    ///
    /// # Errors
    /// Refuses a middle that is not finite, azimuths that are not uniform over a turn, and rows that are not n finite
    /// factors.
    pub fn new(
        middle_mm: [f64; 2],
        azimuth_deg: Vec<f64>,
        weights: Vec<Vec<f64>>,
    ) -> Result<Self, Invalid> {
        if let Some(i) = (0..2).find(|i| !middle_mm[*i].is_finite()) {
            let problem = format!("is {}", middle_mm[i]);
            return Err(Invalid::at_index(
                "azimuth_middle_mm",
                i,
                problem,
                "give a point of the part",
            ));
        }
        let turn = TurnWeights::new(["azimuth_deg", "azimuth_weight"], azimuth_deg, weights)?;
        Ok(Self { middle_mm, turn })
    }

    /// Returns the point [x, y] of the part about which the azimuth is measured, mm.
    pub fn middle_mm(&self) -> [f64; 2] {
        self.middle_mm
    }

    /// Returns the factors with the azimuths at which they are sampled.
    pub fn turn(&self) -> &TurnWeights {
        &self.turn
    }

    /// Returns the factor z_k in (2) of the module for the kernel with the index `kernel` and a tool at `tool_mm` [x,
    /// y].
    fn factor_of(&self, kernel: usize, tool_mm: [f64; 2]) -> f64 {
        let [dx, dy] = [0, 1].map(|i| tool_mm[i] - self.middle_mm[i]);
        self.turn.factor_of(kernel, dy.atan2(dx))
    }

    /// Returns the positions [x, y] at the distance `radius_mm` from the middle, one for each azimuth, mm.
    fn places(&self, radius_mm: f64) -> impl Iterator<Item = [f64; 2]> {
        self.turn.angle_deg.iter().map(move |degrees| {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            [self.middle_mm[0] + radius_mm * cosine, self.middle_mm[1] + radius_mm * sine]
        })
    }
}

/// Factor of the removal rate in the course of a run: c in (1) of the module.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeFactor {
    /// Times (m) from the start of the run, s; ascending.
    pub time_s: Vec<f64>,
    /// Factor of the removal rate at these times (m), dimensionless.
    pub factor: Vec<f64>,
}

/// A kernel and its weight over the positions of the tool.
#[derive(Clone, Debug)]
pub struct Component {
    /// Kernel phi_k of the module, nm/s; unlike a TIF it may be negative.
    kernel: Tif,
    /// Samples of the weight with the extrapolated (ghost) nodes of Keys' interpolation, (ny+2, nx+2).
    weight: Array2<f64>,
}

impl Component {
    /// Returns the kernel, nm/s; its samples may be negative.
    pub fn kernel(&self) -> &Tif {
        &self.kernel
    }
}

/// Variation of a tool over the part and in time: the kernels, weights and factors in (1) of the module.
#[derive(Clone, Debug)]
pub struct Variation {
    components: Vec<Component>,
    positions: Grid,
    azimuth: Option<AzimuthWeights>,
    heading: Option<TurnWeights>,
    pixels: Option<PixelFactor>,
    time: Option<TimeFactor>,
}

/// Position of the tool and direction of its motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Position of the tool [x, y], mm.
    pub position_mm: [f64; 2],
    /// Direction of the motion, rad from positive x towards positive y.
    pub heading_rad: f64,
}

impl Pose {
    /// Returns the pose of a tool at a position [x, y] that moves along positive x, for tools that do not turn with
    /// their motion.
    pub fn along_x(position_mm: [f64; 2]) -> Self {
        Self { position_mm, heading_rad: 0.0 }
    }
}

impl Variation {
    /// Returns the variation with kernels and weights that [`Tif::varying`] has checked. Refuses factors of wrong
    /// shape, and factors of pixels or time that are not between 0.001 and 1000.
    pub(crate) fn new(
        kernels: Vec<Tif>,
        weights: &[Array2<f64>],
        positions: Grid,
        (azimuth, heading): (Option<AzimuthWeights>, Option<TurnWeights>),
        pixels: Option<PixelFactor>,
        time: Option<TimeFactor>,
    ) -> Result<Self, Invalid> {
        if let Some(azimuth) = &azimuth {
            azimuth.turn.check_kernels("azimuth_weight", kernels.len())?;
        }
        if let Some(heading) = &heading {
            heading.check_kernels("heading_weight", kernels.len())?;
        }
        if let Some(PixelFactor { grid, factor }) = &pixels {
            if factor.dim() != grid.shape() {
                let problem = format!("has shape {:?}, its grid {:?}", factor.dim(), grid.shape());
                return Err(Invalid::whole("factor", problem, "give one factor per pixel"));
            }
            if let Some((index, v)) = factor.indexed_iter().find(|(_, v)| !is_factor(**v)) {
                return Err(Invalid::at_index("factor", index, format!("is {v}"), FACTOR_REMEDY));
            }
        }
        if let Some(TimeFactor { time_s, factor }) = &time {
            if time_s.len() != factor.len() || time_s.is_empty() {
                let problem = format!("has {} elements for {} times", factor.len(), time_s.len());
                return Err(Invalid::whole("time_factor", problem, "give one factor per time"));
            }
            if let Some(i) = (1..time_s.len()).find(|i| time_s[*i] <= time_s[*i - 1]) {
                let problem = format!("is {} s after {} s", time_s[i], time_s[i - 1]);
                return Err(Invalid::at_index("time_s", i, problem, "give ascending times"));
            }
            if let Some(i) = (0..factor.len()).find(|i| !is_factor(factor[*i])) {
                let problem = format!("is {}", factor[i]);
                return Err(Invalid::at_index("time_factor", i, problem, FACTOR_REMEDY));
            }
        }
        let weights = weights.iter().map(|weight| keys::with_ghosts(weight.view()));
        let components = kernels
            .into_iter()
            .zip(weights)
            .map(|(kernel, weight)| Component { kernel, weight })
            .collect();
        Ok(Self { components, positions, azimuth, heading, pixels, time })
    }

    /// Returns the kernels phi_k with their weights a_k; see (1) of the module.
    pub fn components(&self) -> &[Component] {
        &self.components
    }

    /// Returns the grid of tool positions at which the weights are sampled.
    pub fn positions(&self) -> &Grid {
        &self.positions
    }

    /// Returns the samples of the weight (ny, nx) of the component with this index, dimensionless.
    pub(crate) fn weight_samples(&self, component: usize) -> Array2<f64> {
        let (ny, nx) = self.positions.shape();
        self.components[component].weight.slice(ndarray::s![1..=ny, 1..=nx]).to_owned()
    }

    /// Returns the factors by azimuth as they were given, or `None` if there are none.
    pub fn azimuth_weights(&self) -> Option<&AzimuthWeights> {
        self.azimuth.as_ref()
    }

    /// Returns the factors by heading as they were given, or `None` if there are none.
    pub fn heading_weights(&self) -> Option<&TurnWeights> {
        self.heading.as_ref()
    }

    /// Returns the poses of the tool at which the weights are sampled: the positions of the grid, one position for each
    /// azimuth, and the middle of the grid at each heading. The positions of the grid take the headings in turn.
    pub(crate) fn sampled(&self) -> Vec<Pose> {
        let Grid { x, y } = &self.positions;
        let mut headings: Vec<f64> = match &self.heading {
            Some(heading) => heading.angle_deg.iter().map(|d| d.to_radians()).collect(),
            None => Vec::new(),
        };
        let middle_mm = [x, y].map(|axis| 0.5 * (axis.start_mm() + axis.end_mm()));
        let turning: Vec<Pose> =
            headings.iter().map(|h| Pose { position_mm: middle_mm, heading_rad: *h }).collect();
        if headings.is_empty() {
            headings.push(0.0);
        }
        let places = (0..y.len())
            .flat_map(|r| (0..x.len()).map(move |c| [x.coordinate_mm(c), y.coordinate_mm(r)]));
        let mut poses: Vec<Pose> = places
            .zip(headings.iter().cycle())
            .map(|(position_mm, heading)| Pose { position_mm, heading_rad: *heading })
            .collect();
        if let Some(azimuth) = &self.azimuth {
            let radius_mm = 0.25 * (x.end_mm() - x.start_mm() + y.end_mm() - y.start_mm());
            let around = azimuth.places(radius_mm);
            poses.extend(around.map(|position_mm| Pose { position_mm, heading_rad: headings[0] }));
        }
        poses.extend(turning);
        poses
    }

    /// Returns the factor of the pixels as it was given, or `None` if it is 1.
    pub fn pixel_factor(&self) -> Option<&PixelFactor> {
        self.pixels.as_ref()
    }

    /// Returns the factor of the time as it was given, or `None` if it is 1.
    pub fn time_factor(&self) -> Option<&TimeFactor> {
        self.time.as_ref()
    }

    /// Returns the weight a_k h_k in (1) of the module for the component with this index and a tool in a pose,
    /// dimensionless.
    pub fn weight(&self, component: usize, tool: Pose) -> f64 {
        let Pose { position_mm, heading_rad } = tool;
        let mut weight = keys_at(&self.positions, &self.components[component].weight, position_mm);
        if let Some(azimuth) = &self.azimuth {
            weight *= azimuth.factor_of(component, position_mm);
        }
        if let Some(heading) = &self.heading {
            weight *= heading.factor_of(component, heading_rad);
        }
        weight
    }

    /// Returns the removal rate of a tool in a pose at the offsets of the kernels (my, mx), nm/s: the sum in (1) of the
    /// module, without the factors of pixels and time.
    pub fn rate_at(&self, tool: Pose) -> Array2<f64> {
        let mut rate = Array2::zeros(self.components[0].kernel.rate_nm_per_s().dim());
        for (k, component) in self.components.iter().enumerate() {
            rate.scaled_add(self.weight(k, tool), component.kernel.rate_nm_per_s());
        }
        rate
    }

    /// Returns the factor of the pixels, g in (1) of the module, on the pixels of a map (ny, nx), or `None` if it is 1.
    /// Pixels beyond the samples have the factor of the nearest one.
    pub fn factor_on(&self, map: &Grid) -> Option<Cow<'_, Array2<f64>>> {
        let PixelFactor { grid, factor } = self.pixels.as_ref()?;
        if grid == map {
            return Some(Cow::Borrowed(factor));
        }
        let with_ghosts = keys::with_ghosts(factor.view());
        let factor = Array2::from_shape_fn(map.shape(), |(r, c)| {
            keys_at(grid, &with_ghosts, [map.x.coordinate_mm(c), map.y.coordinate_mm(r)])
        });
        Some(Cow::Owned(factor))
    }

    /// Returns the variation without its factor of the time, as the tool is while that factor is 1.
    pub(crate) fn without_time(&self) -> Self {
        Self { time: None, ..self.clone() }
    }

    /// Returns the variation with the factor of the pixels shifted by `by_mm` [x, y].
    pub(crate) fn with_pixels_moved(&self, by_mm: [f64; 2]) -> Result<Self, Invalid> {
        let mut moved = self.clone();
        if let Some(pixels) = &mut moved.pixels {
            pixels.grid = pixels.grid.moved(by_mm)?;
        }
        Ok(moved)
    }

    /// Returns the same weights and factors with other kernels, one for each.
    pub(crate) fn with_kernels(&self, kernels: Vec<Tif>) -> Self {
        let mut variation = self.clone();
        for (component, kernel) in variation.components.iter_mut().zip(kernels) {
            component.kernel = kernel;
        }
        variation
    }
}

/// Remedy in the message for a factor that is not between 0.001 and 1000.
const FACTOR_REMEDY: &str =
    "give a factor of the rate between 0.001 and 1000, 1 where the rate is that of the kernels";

fn is_factor(v: f64) -> bool {
    (LEAST_FACTOR..=LARGEST_FACTOR).contains(&v)
}

impl TimeFactor {
    /// Returns the factor c in (1) of the module at the time `time_s` since the start of the run.
    pub fn factor_at(&self, time_s: f64) -> f64 {
        let Self { time_s: times, factor } = self;
        let after = times.partition_point(|t| *t <= time_s);
        if after == 0 {
            return factor[0];
        }
        let Some(end) = times.get(after) else { return factor[after - 1] };
        let start = times[after - 1];
        let f = (time_s - start) / (end - start);
        (1.0 - f) * factor[after - 1] + f * factor[after]
    }

    /// Returns the mean of the factor c between two times of the run, s: exact, as it is linear between its samples.
    /// For an empty interval it is the factor at `from_s`.
    pub fn mean(&self, from_s: f64, to_s: f64) -> f64 {
        if to_s <= from_s {
            return self.factor_at(from_s);
        }
        let inside = self.time_s.iter().copied().filter(|t| *t > from_s && *t < to_s);
        let mut sum = 0.0;
        let mut before = from_s;
        for t in inside.chain([to_s]) {
            sum += 0.5 * (self.factor_at(before) + self.factor_at(t)) * (t - before);
            before = t;
        }
        sum / (to_s - from_s)
    }

    /// Returns the time after `from_s`, s, in which the tool removes as much as in `effective_s` at the factor 1. It is
    /// exact, as the factor is linear between its samples.
    pub fn duration_s(&self, from_s: f64, effective_s: f64) -> f64 {
        let mut before = from_s;
        let mut left = effective_s;
        for end in self.time_s.iter().copied().filter(|t| *t > from_s) {
            let length = end - before;
            let c = self.factor_at(before);
            let c_end = self.factor_at(end);
            let slope = (c_end - c) / length;
            let until_end = 0.5 * (c + c_end) * length;
            if left <= until_end {
                // c u + slope u^2 / 2 = left
                let root = (c * c + 2.0 * slope * left).max(0.0).sqrt();
                return before + 2.0 * left / (c + root) - from_s;
            }
            before = end;
            left -= until_end;
        }
        before + left / self.factor_at(before) - from_s
    }
}

/// Returns Keys' interpolation of samples with ghost nodes at a position [x, y], mm. A position beyond the grid counts
/// as on its border.
fn keys_at(grid: &Grid, with_ghosts: &Array2<f64>, [x, y]: [f64; 2]) -> f64 {
    let (ix, wx) = clamped_tap(&grid.x, x);
    let (iy, wy) = clamped_tap(&grid.y, y);
    (0..4).map(|b| wy[b] * (0..4).map(|a| wx[a] * with_ghosts[[iy + b, ix + a]]).sum::<f64>()).sum()
}

/// Returns the first of the four nodes around a coordinate, and Keys' weights there. A coordinate beyond the axis
/// counts as its end.
fn clamped_tap(axis: &Axis, mm: f64) -> (usize, [f64; 4]) {
    let last = axis.len() - 1;
    let s = ((mm - axis.start_mm()) / axis.step_mm()).clamp(0.0, last as f64);
    let (cell, f) = keys::split(s);
    let cell = cell.clamp(0, last as isize) as usize;
    // The last node belongs to the cell before it; a single node has no cell.
    if cell == last && last > 0 { (last - 1, keys::weights(1.0)) } else { (cell, keys::weights(f)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_duration_removes_what_it_is_for() {
        let time = TimeFactor { time_s: vec![2.0, 5.0, 9.0], factor: vec![1.0, 0.4, 1.6] };
        for from_s in [0.0, 1.7, 3.0, 8.9, 20.0] {
            for effective_s in [0.0, 1e-6, 0.7, 2.5, 30.0] {
                let t = time.duration_s(from_s, effective_s);
                let removed = t * time.mean(from_s, from_s + t);
                // Rounding of times up to 50 s.
                assert!((removed - effective_s).abs() < 1e-12, "{from_s} {effective_s}: {removed}");
            }
        }
    }
}
