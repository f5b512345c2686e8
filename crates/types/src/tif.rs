//! The tool influence function (TIF): removal rate of the resting tool at every offset from it.

use std::{borrow::Cow, ops::Range, sync::Arc};

use ndarray::{Array2, ArrayView1, Axis as NdAxis, s};
use planish_numerics::{keys, statistics};

use crate::{
    Axis, AzimuthWeights, Grid, Invalid, PixelFactor, Pose, Surface, TifLattice, TimeFactor,
    TurnWeights, Variation, text::significant,
};

/// Largest rate, nm/s. A larger rate is a mistake in the units.
const LARGEST_RATE: f64 = 1e12;
/// Smallest peak, nm/s. A smaller peak is a mistake in the units.
const SMALLEST_PEAK: f64 = 1e-12;

/// Magnitude of the lowest rate that is accepted without noise, relative to the peak. It covers the
/// interpolation and the baseline of measured spots. Larger: more of a real negative lobe passes.
/// Smaller: spots without noise need exact baselines.
const NEGATIVE_SYSTEMATIC: f64 = 0.02;

/// Parameter of the extreme-value factor of [`check_sign`]: bound on the probability that white
/// noise alone has a spot refused. Larger: more good spots are refused. Smaller: deeper negative
/// lobes pass.
const REFUSED_BY_NOISE: f64 = 1e-3;

/// Magnitude of the lowest rate that noise can explain, relative to the peak. Larger: the peak is
/// less than 20 times the noise, and a spot cannot be told from one with a negative lobe. Smaller:
/// more noisy spots are refused.
const LARGEST_NEGATIVE: f64 = 0.25;

/// Magnitude of the lowest accepted rate of a tool that varies, relative to its peak at the same position. It covers
/// the error of a tool that too few kernels represent. Larger: more of a mistake in the weights passes. Smaller: tools
/// of few kernels are refused.
const NEGATIVE_OF_PLACE: f64 = 0.1;

/// Smallest number of differences for an estimate of the noise; with fewer, the noise counts as 0.
/// Smaller: the median has a standard error above 20 %. Larger: small TIFs get no allowance for
/// noise.
const LEAST_DIFFERENCES: usize = 32;

/// Ratio of the standard deviation of normal noise to the median of its magnitude, 1 / 0.6745
/// (derived).
const SIGMA_PER_MEDIAN: f64 = 1.482_602_218_505_602;

/// Distances between the three samples of a second difference along the border, in samples. Smaller: correlated noise
/// cancels in the differences. Larger: the slope of the spot enters the estimate. Chosen: noise of instruments is
/// correlated over less than eight samples.
const BORDER_LAGS: [usize; 3] = [2, 4, 8];

/// Number of zero samples that stay in each margin of a TIF when the others are cut off. Smaller: the interpolation at
/// its edge changes, because a ghost node is made of three samples. Larger: more memory and time, no change.
const MARGIN: usize = 3;

/// Removal rate `R(dx, dy)` in nm/s, sampled at the offsets (pixel - tool) of `grid`.
///
/// Between its samples, R is Keys' cubic convolution ([`planish_numerics::keys`]). Outside the
/// closed rectangle of its samples it is zero. A rotated or asymmetric TIF is used as it is given:
/// removal(pixel) = integral over time of R(pixel - tool), a convolution.
///
/// A tool that is not the same everywhere has a [`Variation`] beside its samples. The samples are then those of the
/// mean tool, which determines widths, pitches and reach. Only code that asks for the variation uses the difference; a
/// method that cannot use it refuses such a tool by [`Tif::same_everywhere`].
#[derive(Clone, Debug)]
pub struct Tif {
    grid: Grid,
    rate_nm_per_s: Array2<f64>,
    /// Samples with one extrapolated (ghost) node on every side for Keys' interpolation, (my+2, mx+2). There is one
    /// node more along an axis whose edge is beyond the last sample.
    with_ghosts: Array2<f64>,
    /// Upper edge [x, y], mm: the offset of the last sample, or up to one step more for samples on the lattice of a
    /// map.
    edge_mm: [f64; 2],
    /// Lattice of the map on which the TIF was resampled; `None` for a TIF as it was measured.
    lattice: Option<TifLattice>,
    variation: Option<Arc<Variation>>,
}

/// Arrays of a tool that varies over the part, not checked yet; see [`Variation`] for the formula.
#[derive(Clone, Debug)]
pub struct VaryingTif {
    /// Offsets (pixel - tool) of the samples of the kernels.
    pub offsets: Grid,
    /// Kernels (k), each (my, mx), nm/s: removal rates whose weighted sum is the rate of the tool.
    pub kernels: Vec<Array2<f64>>,
    /// Tool positions at which the weights are sampled.
    pub positions: Grid,
    /// Weights of the kernels (k), each (ny, nx), dimensionless.
    pub weights: Vec<Array2<f64>>,
    /// Factors of the weights that depend on the azimuth of the tool position; `None` if there are none.
    pub azimuth: Option<AzimuthWeights>,
    /// Factors of the weights that depend on the heading, the direction of the motion; `None` if there are none.
    pub heading: Option<TurnWeights>,
    /// Factor of the rate at every pixel of the map; `None` if it is 1.
    pub pixels: Option<PixelFactor>,
    /// Factor of the rate over the time since the start of the run; `None` if it is 1.
    pub time: Option<TimeFactor>,
}

impl Tif {
    /// Returns the TIF with the samples `rate_nm_per_s` (my, mx) at the offsets of `grid`.
    ///
    /// # Errors
    /// Refuses another shape than that of the grid, rates that are not finite or above 1e12 nm/s, rates further below
    /// zero than noise explains, and a TIF that removes nothing.
    pub fn new(grid: Grid, rate_nm_per_s: Array2<f64>) -> Result<Self, Invalid> {
        const NAME: &str = "rate_nm_per_s";
        if rate_nm_per_s.dim() != grid.shape() {
            return Err(Invalid::whole(
                NAME,
                format!(
                    "has shape {:?} but (y_mm, x_mm) have {:?} elements",
                    rate_nm_per_s.dim(),
                    grid.shape()
                ),
                "give one row per y and one column per x",
            ));
        }
        if let Some((index, v)) = rate_nm_per_s.indexed_iter().find(|(_, v)| !is_number(**v)) {
            let remedy = "give finite nm/s (at most 1e12); fill or crop the TIF first";
            return Err(Invalid::at_index(NAME, index, format!("is {v:?}"), remedy));
        }
        let peak = rate_nm_per_s.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if peak < SMALLEST_PEAK {
            return Err(Invalid::whole(
                NAME,
                format!("has no positive rate (largest {peak} nm/s)"),
                "a TIF states removal as a positive rate; check its sign and that it is not empty",
            ));
        }
        check_sign(NAME, &rate_nm_per_s, peak)?;
        let tif = Self::unchecked(grid, rate_nm_per_s, ends_mm(&grid));
        let vrr = tif.vrr_nm_mm2_per_s();
        if vrr <= 0.0 {
            return Err(Invalid::whole(
                NAME,
                format!("has the volumetric removal rate {vrr} nm mm^2/s"),
                "a TIF must remove material",
            ));
        }
        Ok(tif)
    }

    /// Returns a tool that varies, see [`Variation`]. One kernel with the weight 1 everywhere and no factor gives an
    /// ordinary TIF.
    ///
    /// # Errors
    /// Refuses arrays of wrong shape, numbers that are not finite, and a tool that removes no material, or adds some,
    /// at a sample of the weights.
    pub fn varying(numbers: VaryingTif) -> Result<Self, Invalid> {
        let VaryingTif { offsets, kernels, positions, weights, azimuth, heading, pixels, time } =
            numbers;
        if kernels.is_empty() || kernels.len() != weights.len() {
            let problem = format!("has {} kernels for {} weights", kernels.len(), weights.len());
            return Err(Invalid::whole("rate_nm_per_s", problem, "give one weight per kernel"));
        }
        for (name, grid, arrays) in
            [("rate_nm_per_s", &offsets, &kernels), ("weight", &positions, &weights)]
        {
            if let Some(k) = arrays.iter().position(|a| a.dim() != grid.shape()) {
                let problem =
                    format!("has shape {:?}, its grid {:?}", arrays[k].dim(), grid.shape());
                return Err(Invalid::at_index(
                    name,
                    k,
                    problem,
                    "give one number per place of the grid",
                ));
            }
            for (k, array) in arrays.iter().enumerate() {
                if let Some(((r, c), v)) = array.indexed_iter().find(|(_, v)| !is_number(**v)) {
                    let problem = format!("is {v:?}");
                    return Err(Invalid::at_index(name, [k, r, c], problem, "give finite numbers"));
                }
            }
        }
        let same = weights.len() == 1 && weights[0].iter().all(|w| *w == 1.0);
        let turns = azimuth.is_some() || heading.is_some();
        if same && !turns && pixels.is_none() && time.is_none() {
            return Self::new(offsets, kernels.into_iter().next().expect("there is one"));
        }
        let edge_mm = ends_mm(&offsets);
        let kernels =
            kernels.into_iter().map(|rate| Self::unchecked(offsets, rate, edge_mm)).collect();
        let variation =
            Variation::new(kernels, &weights, positions, (azimuth, heading), pixels, time)?;
        let places = variation.sampled();
        let azimuths = variation.azimuth_weights().map_or(0, |a| a.turn().angle_deg().len());
        let mut mean = Array2::zeros(offsets.shape());
        for (i, place) in places.iter().enumerate() {
            let rate = variation.rate_at(*place);
            let peak = rate.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let lowest = rate.iter().copied().fold(f64::INFINITY, f64::min);
            if peak < SMALLEST_PEAK || lowest < -NEGATIVE_OF_PLACE * peak {
                let [x, y] = place.position_mm.map(|v| significant(v, 5));
                let [low, high] = [lowest, peak].map(|v| significant(v, 5));
                let turns = variation.heading_weights().map_or(String::new(), |_| {
                    let degrees = significant(place.heading_rad.to_degrees(), 4);
                    format!(" with the heading {degrees} degrees")
                });
                let problem = format!(
                    "makes a tool at x = {x} mm, y = {y} mm{turns} with rates from {low} to {high} nm/s"
                );
                let remedy = "removal is positive: check kernels and weights, or use more kernels";
                // The places of the grid come first, then one for each azimuth, then one for each heading.
                let [rows, columns] = [positions.y.len(), positions.x.len()];
                return Err(match i.checked_sub(rows * columns) {
                    None => {
                        Invalid::at_index("weight", (i / columns, i % columns), problem, remedy)
                    }
                    Some(i) if i < azimuths => {
                        Invalid::at_index("azimuth_weight", i, problem, remedy)
                    }
                    Some(i) => Invalid::at_index("heading_weight", i - azimuths, problem, remedy),
                });
            }
            mean.scaled_add(1.0 / places.len() as f64, &rate);
        }
        Ok(Self { variation: Some(Arc::new(variation)), ..Self::new(offsets, mean)? })
    }

    /// Returns the variation of the tool over the part and in time, or `None` if it is the same everywhere and at all
    /// times.
    pub fn variation(&self) -> Option<&Variation> {
        self.variation.as_deref()
    }

    /// Returns the lattice of the map on which the TIF was resampled, or `None` for a TIF as it was measured.
    pub(crate) fn lattice(&self) -> Option<&TifLattice> {
        self.lattice.as_ref()
    }

    /// Returns this TIF, marked as resampled on `lattice`.
    pub(crate) fn with_lattice(self, lattice: TifLattice) -> Self {
        Self { lattice: Some(lattice), ..self }
    }

    /// Returns this TIF as the mean tool of `variation`; with `None`, as a tool that is the same everywhere.
    pub(crate) fn with_variation(self, variation: Option<Variation>) -> Self {
        Self { variation: variation.map(Arc::new), ..self }
    }

    /// Returns the numbers from which [`Self::varying`] makes this tool. A tool that does not vary has one kernel, with
    /// the weight 1 at the ends of its samples.
    pub fn numbers(&self) -> VaryingTif {
        let Some(v) = self.variation() else {
            let [x, y] = [self.grid.x, self.grid.y]
                .map(|axis| Axis::new(axis.start_mm(), axis.end_mm() - axis.start_mm(), 2));
            let positions = match (x, y) {
                (Ok(x), Ok(y)) => Grid { x, y },
                // A single sample along an axis has no ends.
                _ => self.grid,
            };
            return VaryingTif {
                offsets: self.grid,
                kernels: vec![self.rate_nm_per_s.clone()],
                positions,
                weights: vec![Array2::ones(positions.shape())],
                azimuth: None,
                heading: None,
                pixels: None,
                time: None,
            };
        };
        VaryingTif {
            offsets: self.grid,
            kernels: v.components().iter().map(|c| c.kernel().rate_nm_per_s.clone()).collect(),
            positions: *v.positions(),
            weights: (0..v.components().len()).map(|k| v.weight_samples(k)).collect(),
            azimuth: v.azimuth_weights().cloned(),
            heading: v.heading_weights().cloned(),
            pixels: v.pixel_factor().cloned(),
            time: v.time_factor().cloned(),
        }
    }

    /// Refuses a tool that varies. `method` names the method that needs a tool that is the same everywhere, for the
    /// message.
    pub fn same_everywhere(&self, method: &str) -> Result<(), Invalid> {
        match self.variation {
            None => Ok(()),
            Some(_) => Err(Invalid::whole(
                "tif",
                format!(
                    "varies over the part, and {method} assumes a tool that is the same everywhere"
                ),
                "give a tif; planish dwell bounded-least-squares, planish refine, planish joint and planish simulate \
                 take a tool that varies",
            )),
        }
    }

    /// Refuses a tool whose rate depends on the time of the run. `method` names the method that needs a constant rate,
    /// for the message.
    pub fn same_at_all_times(&self, method: &str) -> Result<(), Invalid> {
        match self.variation().and_then(Variation::time_factor) {
            None => Ok(()),
            Some(_) => Err(Invalid::whole(
                "tif",
                format!(
                    "has a rate that depends on the time of the run, and {method} assumes a constant one"
                ),
                "give a tool without time_factor; planish dwell bounded-least-squares, planish refine, planish joint and \
                 planish simulate take one",
            )),
        }
    }

    /// Refuses a tool that turns with the direction of the motion. `method` names the method that takes no such tool,
    /// for the message.
    pub fn same_in_all_directions(&self, method: &str) -> Result<(), Invalid> {
        match self.variation().and_then(Variation::heading_weights) {
            None => Ok(()),
            Some(_) => Err(Invalid::whole(
                "tif",
                format!("turns with the direction of the motion, and {method} takes no such tool"),
                "give a tool without heading_weight; planish dwell bounded-least-squares, planish refine, planish joint \
                 and planish simulate take one",
            )),
        }
    }

    /// Returns the mean tool without its variation: a TIF that is the same everywhere.
    pub fn mean_tool(&self) -> Self {
        Self { variation: None, ..self.clone() }
    }

    /// Returns the tool without its factor of the time, as it is while that factor is 1.
    pub fn without_time(&self) -> Cow<'_, Self> {
        match &self.variation {
            Some(v) if v.time_factor().is_some() => {
                let variation = Some(Arc::new(v.without_time()));
                Cow::Owned(Self { variation, ..self.clone() })
            }
            _ => Cow::Borrowed(self),
        }
    }

    /// Returns the removal rate (1) of the module of [`Variation`], without the factors of pixels and time, nm/s. The
    /// offset (pixel - tool) is in mm; `tool` is the position and the heading.
    pub fn rate_of_tool_at(&self, tool: Pose, [dx_mm, dy_mm]: [f64; 2]) -> f64 {
        let Some(variation) = &self.variation else { return self.rate_at(dx_mm, dy_mm) };
        let components = variation.components().iter().enumerate();
        components.map(|(k, c)| variation.weight(k, tool) * c.kernel().rate_at(dx_mm, dy_mm)).sum()
    }

    /// Returns the tool with resampled arrays. `resample` gets the mean tool or a kernel, and returns the grid and the
    /// samples, nm/s, that replace its own; those of a kernel may be negative.
    ///
    /// # Errors
    /// Refuses what `resample` refuses, and samples of which [`Self::new`] makes no TIF.
    pub fn with_kernels(
        &self,
        resample: impl Fn(&Self) -> Result<(Grid, Array2<f64>), Invalid>,
    ) -> Result<Self, Invalid> {
        let (grid, rate) = resample(&self.mean_tool())?;
        let mut mean = Self::new(grid, rate)?.with_edge(self.edge_on(&grid));
        if grid == self.grid {
            // These samples are on the lattice, whatever they replace.
            mean.lattice = self.lattice.map(|l| TifLattice { error: 0.0, volume_change: 0.0, ..l });
        }
        let Some(variation) = &self.variation else { return Ok(mean) };
        let mut kernels = Vec::new();
        for component in variation.components() {
            let (grid, rate) = resample(component.kernel())?;
            kernels.push(Self::unchecked(grid, rate, self.edge_on(&grid)));
        }
        Ok(Self { variation: Some(Arc::new(variation.with_kernels(kernels))), ..mean })
    }

    /// Returns the upper edge [x, y] of samples on `grid`, mm: the edge of this TIF if `grid` is its own, else the last
    /// sample.
    fn edge_on(&self, grid: &Grid) -> [f64; 2] {
        if *grid == self.grid { self.edge_mm } else { ends_mm(grid) }
    }

    /// Returns the TIF without margins in which all samples are 0. Each margin keeps three zero samples, so
    /// that the interpolation next to it does not change. A TIF is often stored with more room than
    /// the tool needs.
    pub fn without_zero_margins(&self) -> Cow<'_, Self> {
        let rows = self.used(NdAxis(0));
        let columns = self.used(NdAxis(1));
        let shape = (rows.len(), columns.len());
        if shape == self.grid.shape() || self.edge_mm != ends_mm(&self.grid) {
            return Cow::Borrowed(self);
        }
        let x = self.grid.x.crop(columns.start, columns.end - 1);
        let y = self.grid.y.crop(rows.start, rows.end - 1);
        let (Ok(x), Ok(y)) = (x, y) else { return Cow::Borrowed(self) };
        let grid = Grid { x, y };
        let cropped = |tif: &Self| {
            let rate = tif.rate_nm_per_s.slice(s![rows.clone(), columns.clone()]).to_owned();
            Self { lattice: self.lattice, ..Self::unchecked(grid, rate, ends_mm(&grid)) }
        };
        let variation = self
            .variation()
            .map(|v| v.with_kernels(v.components().iter().map(|c| cropped(c.kernel())).collect()));
        Cow::Owned(cropped(self).with_variation(variation))
    }

    /// Returns the range of rows (axis 0) or columns (axis 1) that contain a sample other than 0, with the kept margin.
    /// The samples are those of the mean tool and of all kernels.
    fn used(&self, axis: NdAxis) -> Range<usize> {
        let kernels = self.variation().map_or(&[][..], Variation::components);
        let n = self.rate_nm_per_s.len_of(axis);
        let is_used = |i: &usize| {
            let arrays = kernels.iter().map(|c| &c.kernel().rate_nm_per_s);
            arrays
                .chain([&self.rate_nm_per_s])
                .any(|a| a.index_axis(axis, *i).iter().any(|r| *r != 0.0))
        };
        let first = (0..n).find(is_used).unwrap_or(0).saturating_sub(MARGIN);
        let last = (0..n).rev().find(is_used).unwrap_or(n);
        first..(last + MARGIN + 1).min(n)
    }

    /// Returns the offsets of the samples from the tool centre.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Returns the removal rates at the samples (my, mx), nm/s; those of the mean tool if it varies.
    pub fn rate_nm_per_s(&self) -> &Array2<f64> {
        &self.rate_nm_per_s
    }

    /// Returns the samples with the extrapolated (ghost) nodes of Keys' interpolation, (my+2, mx+2), nm/s; node (r, c)
    /// is element [r+1, c+1]. There is one ghost node more along an axis whose upper edge is beyond the last sample.
    pub fn with_ghosts(&self) -> &Array2<f64> {
        &self.with_ghosts
    }

    /// Returns the largest sample of the removal rate, nm/s.
    pub fn peak_nm_per_s(&self) -> f64 {
        self.rate_nm_per_s.iter().copied().fold(0.0, f64::max)
    }

    /// Returns the volumetric removal rate, nm mm^2/s: the sum of the samples times the area of a sample.
    pub fn vrr_nm_mm2_per_s(&self) -> f64 {
        self.rate_nm_per_s.sum() * self.grid.pixel_mm2()
    }

    /// Returns the centroid of the removal [x, y], mm, relative to the position of the tool.
    pub fn centroid_mm(&self) -> [f64; 2] {
        let Grid { x, y } = &self.grid;
        let mut sums = [0.0; 2];
        for ((r, c), rate) in self.rate_nm_per_s.indexed_iter() {
            sums[0] += rate * x.coordinate_mm(c);
            sums[1] += rate * y.coordinate_mm(r);
        }
        sums.map(|sum| sum / self.rate_nm_per_s.sum())
    }

    /// Returns the effective area `(integral of R)^2 / integral of R^2`, mm^2. For a flat tool it is the area of the
    /// tool, for a Gaussian `4 pi sigma^2`.
    pub fn effective_area_mm2(&self) -> f64 {
        let squares: f64 = self.rate_nm_per_s.iter().map(|r| r * r).sum();
        self.rate_nm_per_s.sum().powi(2) / squares * self.grid.pixel_mm2()
    }

    /// Returns the width `(<R^2> / <|grad R|^2>)^1/2`, mm, with < > for the mean over the samples. For a Gaussian it is
    /// the standard deviation.
    pub fn width_mm(&self) -> f64 {
        let [along_x, along_y] = self.slope_energy_per_mm2();
        (along_x + along_y).sqrt().recip()
    }

    /// Returns the diameter of the circle whose area is that of the samples at or above half the peak, mm.
    ///
    /// It is the full width at half maximum of a round TIF, and the geometric mean of the two axes of an elliptical
    /// one.
    pub fn half_maximum_width_mm(&self) -> f64 {
        let half = 0.5 * self.peak_nm_per_s();
        let count = self.rate_nm_per_s.iter().filter(|v| **v >= half).count();
        // pi (W/2)^2 = A
        2.0 * (count as f64 * self.grid.pixel_mm2() / std::f64::consts::PI).sqrt()
    }

    /// Returns the spread `(<R^2 r^2> / <R^2>)^1/2`, mm, with the distance r from the centroid of R^2. For a Gaussian
    /// it is the standard deviation, as [`Self::width_mm`] is; for a spot with steep flanks it is larger.
    pub fn spread_mm(&self) -> f64 {
        let Grid { x, y } = &self.grid;
        let mut energy = 0.0;
        let mut first = [0.0; 2];
        let mut second = 0.0;
        for ((r, c), rate) in self.rate_nm_per_s.indexed_iter() {
            let square = rate * rate;
            let [x, y] = [x.coordinate_mm(c), y.coordinate_mm(r)];
            energy += square;
            first[0] += square * x;
            first[1] += square * y;
            second += square * (x * x + y * y);
        }
        let centre = first.map(|sum| sum / energy);
        (second / energy - centre[0].powi(2) - centre[1].powi(2)).max(0.0).sqrt()
    }

    /// Returns the mean squared slopes `<R_x^2> / <R^2>` and `<R_y^2> / <R^2>` from differences of the samples, 1/mm^2.
    /// Beyond its samples the TIF falls to zero within a step, as with a margin of zeros. For a flat pad this step is
    /// the only contribution.
    pub fn slope_energy_per_mm2(&self) -> [f64; 2] {
        let rate = &self.rate_nm_per_s;
        let [step_x_mm, step_y_mm] = [self.grid.x.step_mm(), self.grid.y.step_mm()];
        let energy: f64 = rate.iter().map(|r| r * r).sum();
        let along_x: f64 = rate.rows().into_iter().map(|r| squared_slopes(r, step_x_mm)).sum();
        let along_y: f64 = rate.columns().into_iter().map(|c| squared_slopes(c, step_y_mm)).sum();
        [along_x, along_y].map(|slope| slope / energy)
    }

    /// Returns the offset of the centre of removal from the position of the tool, [x, y], mm: the centroid of the
    /// removal. It is 0 along an axis where it is less than half a pixel of `map`, because an aperture of pixels has no
    /// finer resolution.
    pub fn off_centre_mm(&self, map: &Grid) -> [f64; 2] {
        let mut centroid_mm = self.centroid_mm();
        for (mm, axis) in centroid_mm.iter_mut().zip([&map.x, &map.y]) {
            if mm.abs() < 0.5 * axis.step_mm() {
                *mm = 0.0;
            }
        }
        centroid_mm
    }

    /// Returns the map and the TIF for a tool position at the centre of removal, or `None` if the offset is 0.
    ///
    /// ```text
    /// removal(p) = sum over time of R(p - q),   p - q = (p - c) - q + c,   q the tool position
    /// ```
    ///
    /// The map shifted by -c and the TIF with offsets smaller by c give the same removal along the same path. c is the
    /// centroid of the removal; the shifted tool removes around its own position.
    ///
    /// # Errors
    /// Refuses an offset with which the coordinates would not be finite.
    pub fn centred_on(&self, map: &Surface) -> Result<Option<(Surface, Self)>, Invalid> {
        let off_centre_mm = self.off_centre_mm(map.grid());
        if off_centre_mm == [0.0; 2] {
            return Ok(None);
        }
        let map = map.seen_by_tool(off_centre_mm)?;
        let by_mm = off_centre_mm.map(|mm| -mm);
        let mut tif = self.moved(by_mm)?;
        if let Some(v) = self.variation() {
            let kernels = v.components().iter().map(|c| c.kernel().moved(by_mm));
            let kernels = kernels.collect::<Result<Vec<_>, _>>()?;
            tif.variation = Some(Arc::new(v.with_pixels_moved(by_mm)?.with_kernels(kernels)));
        }
        Ok(Some((map, tif)))
    }

    /// Returns the mean tool with `by_mm` [x, y] added to all offsets.
    fn moved(&self, by_mm: [f64; 2]) -> Result<Self, Invalid> {
        let edge_mm = [0, 1].map(|axis| self.edge_mm[axis] + by_mm[axis]);
        Ok(Self { grid: self.grid.moved(by_mm)?, edge_mm, variation: None, ..self.clone() })
    }

    /// Returns the largest distance of a sample from the position of the tool along x and along y, mm.
    pub fn half_size_mm(&self) -> [f64; 2] {
        [&self.grid.x, &self.grid.y].map(|a| a.start_mm().abs().max(a.end_mm().abs()))
    }

    /// Returns the largest rate on the border relative to the peak: the size of the step at which the samples
    /// end.
    pub fn border_to_peak(&self) -> f64 {
        let samples = self.rate_nm_per_s.indexed_iter();
        let border = samples.filter(|(index, _)| self.is_border(*index));
        border.map(|(_, v)| v.abs()).fold(0.0, f64::max) / self.peak_nm_per_s()
    }

    /// Returns the least-squares plane through the samples of the border, at every sample (my, mx), nm/s. It is level
    /// if the border is one line of samples.
    pub fn border_plane_nm_per_s(&self) -> Array2<f64> {
        let shape = self.grid.shape();
        let border = Array2::from_shape_fn(shape, |index| {
            if self.is_border(index) { self.rate_nm_per_s[index] } else { f64::NAN }
        });
        let x = self.grid.x.coordinates();
        let y = self.grid.y.coordinates();
        let plane = statistics::fit_plane(border.view(), &x, &y);
        let mean = statistics::statistics(border.view()).map_or(0.0, |s| s.mean);
        Array2::from_shape_fn(shape, |(r, c)| plane.map_or(mean, |p| p.a + p.b * x[c] + p.c * y[r]))
    }

    /// Returns true if the sample (row, column) is in the first or last row or column.
    fn is_border(&self, (r, c): (usize, usize)) -> bool {
        let (ny, nx) = self.grid.shape();
        r == 0 || c == 0 || r == ny - 1 || c == nx - 1
    }

    /// Returns the removal rate R(dx, dy), nm/s, at the offset (pixel - tool) in mm, by Keys' interpolation; 0 beyond
    /// the edges.
    pub fn rate_at(&self, dx_mm: f64, dy_mm: f64) -> f64 {
        let (Some((ix, fx)), Some((iy, fy))) = (self.cell(0, dx_mm), self.cell(1, dy_mm)) else {
            return 0.0;
        };
        let [wx, wy] = [fx, fy].map(keys::weights);
        // R = sum_b w_b(fy) sum_a w_a(fx) g[iy + b, ix + a]
        (0..4)
            .map(|b| {
                wy[b] * (0..4).map(|a| wx[a] * self.with_ghosts[[iy + b, ix + a]]).sum::<f64>()
            })
            .sum()
    }

    /// Returns the cell of samples that contains an offset along x (`axis` 0) or y (1), and the position in the cell,
    /// 0 to 1 step. `None` where the TIF is zero. The four nodes around cell i are the nodes i to i+3 of
    /// [`Self::with_ghosts`].
    pub fn cell(&self, axis: usize, offset_mm: f64) -> Option<(usize, f64)> {
        let samples = [&self.grid.x, &self.grid.y][axis];
        let last = samples.len() as isize - 1;
        match keys::split((offset_mm - samples.start_mm()) / samples.step_mm()) {
            // The rectangle is closed: the last node belongs to the cell before it.
            (cell, 0.0) if cell == last => Some((samples.len() - 2, 1.0)),
            (cell, f) if (0..last).contains(&cell) => Some((cell as usize, f)),
            (cell, f) if cell == last && f <= self.beyond_steps(axis) + keys::SNAP => {
                Some((cell as usize, f))
            }
            _ => None,
        }
    }

    /// Returns the upper edge [x, y], mm, beyond which the TIF is zero. It is exactly the offset of the last sample, or
    /// up to a step more.
    pub fn edge_mm(&self) -> [f64; 2] {
        self.edge_mm
    }

    /// Returns the distance from the last sample to the upper edge along x (`axis` 0) or y (1), in steps; from 0 to
    /// less than 1.
    fn beyond_steps(&self, axis: usize) -> f64 {
        let samples = [&self.grid.x, &self.grid.y][axis];
        (self.edge_mm[axis] - samples.end_mm()) / samples.step_mm()
    }

    /// Returns a TIF or a kernel of these samples without checks. `edge_mm` is the upper edge [x, y], mm.
    pub(crate) fn unchecked(grid: Grid, rate_nm_per_s: Array2<f64>, edge_mm: [f64; 2]) -> Self {
        let with_ghosts = keys::with_ghosts(rate_nm_per_s.view());
        Self {
            grid,
            rate_nm_per_s,
            with_ghosts,
            edge_mm: ends_mm(&grid),
            lattice: None,
            variation: None,
        }
        .with_edge(edge_mm)
    }

    /// Returns the same samples with the upper edge `edge_mm` [x, y], mm, which is up to a step beyond the last one.
    fn with_edge(mut self, edge_mm: [f64; 2]) -> Self {
        self.edge_mm = edge_mm;
        for axis in [0, 1] {
            if self.beyond_steps(axis) <= keys::SNAP {
                // The rest is rounding: nobody else has to decide whether the edge is the last sample.
                self.edge_mm[axis] = ends_mm(&self.grid)[axis];
                continue;
            }
            let lines = NdAxis(1 - axis);
            let n = self.with_ghosts.len_of(lines);
            let line = |back: usize| self.with_ghosts.index_axis(lines, n - back);
            let next = &line(1) * 3.0 - &(&line(2) * 3.0) + line(3);
            self.with_ghosts.push(lines, next.view()).expect("a line of the array");
        }
        self.with_ghosts = self.with_ghosts.as_standard_layout().into_owned();
        self
    }
}

/// Returns true if a rate or weight is finite and not too large.
fn is_number(value: f64) -> bool {
    value.abs() <= LARGEST_RATE
}

/// Returns the sum of (difference / step)^2 along a row or column of samples, with a zero before and after it.
fn squared_slopes(line: ArrayView1<f64>, step_mm: f64) -> f64 {
    let mut before = 0.0;
    let mut squares = 0.0;
    for rate in line.iter().copied().chain([0.0]) {
        squares += ((rate - before) / step_mm).powi(2);
        before = rate;
    }
    squares
}

/// Returns the offset [x, y] of the last sample, mm.
fn ends_mm(grid: &Grid) -> [f64; 2] {
    [grid.x.end_mm(), grid.y.end_mm()]
}

/// Refuses rates that are further below zero than systematic errors and noise explain.
///
/// ```text
/// R >= -min(0.02 peak + z s, 0.25 peak),   z = (2 ln(N / 1e-3))^1/2
/// ```
///
/// s is the standard deviation from [`noise_nm_per_s`]. The lowest of N samples of normal noise is below -z
/// s with a probability of at most N exp(-z^2 / 2) / 2 = 5e-4.
fn check_sign(name: &'static str, rate: &Array2<f64>, peak: f64) -> Result<(), Invalid> {
    let lowest = rate.iter().copied().fold(0.0, f64::min);
    if lowest >= -NEGATIVE_SYSTEMATIC * peak {
        return Ok(());
    }
    let noise = noise_nm_per_s(rate);
    let factor = (2.0 * (rate.len() as f64 / REFUSED_BY_NOISE).ln()).sqrt();
    let limit = (NEGATIVE_SYSTEMATIC * peak + factor * noise).min(LARGEST_NEGATIVE * peak);
    match rate.indexed_iter().find(|(_, v)| **v < -limit) {
        None => Ok(()),
        Some((index, v)) => {
            let [low, allowed, peak, noise] = [*v, -limit, peak, noise].map(|v| significant(v, 4));
            Err(Invalid::at_index(
                name,
                index,
                format!(
                    "is {low} nm/s, below {allowed} nm/s, the lowest rate that noise of {noise} nm/s explains beside \
                     a peak of {peak} nm/s"
                ),
                "removal is positive; check the sign and the baseline, or average more measurements of the spot",
            ))
        }
    }
}

/// Returns the standard deviation of the noise of the samples, nm/s: the largest of estimates that are
/// insensitive to a smooth spot.
///
/// ```text
/// border     median |r_{k-l} - 2 r_k + r_{k+l}| / (0.6745 sqrt(6))        along the border, l = 2, 4, 8
/// whole      median |sum of [1 -2 1]' [1 -2 1] r| / (0.6745 sqrt(36))     over 3 x 3 samples that are not all 0
/// ```
///
/// The border gives the better estimate of correlated noise, but none if it is tapered to zero.
fn noise_nm_per_s(rate: &Array2<f64>) -> f64 {
    let (ny, nx) = rate.dim();
    let mut largest = 0.0_f64;
    for lag in BORDER_LAGS {
        let mut differences = Vec::new();
        for side in [rate.row(0), rate.row(ny - 1), rate.column(0), rate.column(nx - 1)] {
            for k in 0..side.len().saturating_sub(2 * lag) {
                differences.push((side[k] - 2.0 * side[k + lag] + side[k + 2 * lag]).abs());
            }
        }
        largest = largest.max(deviation_of_differences(differences, 6.0));
    }
    let mut differences = Vec::new();
    for square in rate.windows((3.min(ny), 3.min(nx))) {
        if square.dim() == (3, 3) && square.iter().any(|v| *v != 0.0) {
            let stencil = [1.0, -2.0, 1.0];
            let terms = square.indexed_iter().map(|((r, c), v)| stencil[r] * stencil[c] * v);
            differences.push(terms.sum::<f64>().abs());
        }
    }
    deviation_of_differences(differences, 36.0).max(largest)
}

/// Returns the standard deviation of the noise from the magnitudes of differences of samples, or 0 if there are too
/// few. `squares` is the sum of the squared coefficients of a difference.
fn deviation_of_differences(mut differences: Vec<f64>, squares: f64) -> f64 {
    let n = differences.len();
    if n < LEAST_DIFFERENCES {
        return 0.0;
    }
    let (_, median, _) = differences.select_nth_unstable_by(n / 2, f64::total_cmp);
    SIGMA_PER_MEDIAN * *median / squares.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(half: f64, n: usize) -> Axis {
        Axis::new(-half, 2.0 * half / (n - 1) as f64, n).unwrap()
    }

    #[test]
    fn the_width_is_that_of_a_gaussian_and_knows_where_the_samples_end() {
        let gaussian = |half: f64, n: usize| {
            let x = axis(half, n);
            let rate = Array2::from_shape_fn((n, n), |(r, c)| {
                (-(x.coordinate_mm(r).powi(2) + x.coordinate_mm(c).powi(2)) / (2.0 * 1.5 * 1.5))
                    .exp()
            });
            Tif::new(Grid { x, y: x }, rate).unwrap()
        };
        // Differences of samples lose (step / width)^2 / 24 of a slope, 2e-4.
        assert!((gaussian(9.0, 181).width_mm() / 1.5 - 1.0).abs() < 3e-4);
        // A flat pad of n x n samples: 2 n steps along each axis, over n^2; but for rounding.
        let pad = |n: usize| Array2::from_elem((n, n), 5.0);
        let flat = Tif::new(Grid { x: axis(3.0, 25), y: axis(3.0, 25) }, pad(25)).unwrap();
        assert!((flat.width_mm() / (0.25 * 5.0 / 2.0) - 1.0).abs() < 1e-12);
        // A margin of zeros changes nothing, of the pad and of a Gaussian that ends at its width; coordinates round.
        for cropped in [flat, gaussian(1.5, 31)] {
            let n = cropped.grid().x.len();
            let mut rate = Array2::zeros((n + 2, n + 2));
            rate.slice_mut(s![1..=n, 1..=n]).assign(cropped.rate_nm_per_s());
            let wider = axis(cropped.grid().x.end_mm() + cropped.grid().x.step_mm(), n + 2);
            let padded = Tif::new(Grid { x: wider, y: wider }, rate).unwrap();
            assert!((padded.width_mm() / cropped.width_mm() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn without_its_zero_margins_a_tif_is_the_same() {
        // Before, after, below and above the samples 0, 9, 5 and 2 columns and rows of zeros.
        let rate = Array2::from_shape_fn((10, 17), |(r, c)| {
            let inside = (5..8).contains(&r) && c < 8;
            if inside { 1.0 + ((3 * r + 5 * c) as f64).sin() } else { 0.0 }
        });
        let x = Axis::new(-0.7, 0.1, 17).unwrap();
        let y = Axis::new(-0.5, 0.2, 10).unwrap();
        let tif = Tif::new(Grid { x, y }, rate).unwrap();
        let part = tif.without_zero_margins();
        assert_eq!(part.rate_nm_per_s().dim(), (8, 11));
        // Rounding of a coordinate.
        assert!((part.grid().y.start_mm() + 0.1).abs() < 1e-12);
        let mut largest = 0.0_f64;
        for k in 0..4000 {
            let d = [0.021, 0.0173].map(|step| f64::from(k) * step);
            let (dx, dy) = (d[0] % 2.0 - 0.9, d[1] % 2.4 - 0.7);
            let (whole, part) = (tif.rate_at(dx, dy), part.rate_at(dx, dy));
            // The coordinates round.
            assert!((whole - part).abs() < 1e-12, "{dx} {dy}: {whole} {part}");
            largest = largest.max(whole);
        }
        assert!(largest > 1.5);
        assert!(matches!(part.without_zero_margins(), Cow::Borrowed(_)));
    }

    #[test]
    fn a_paraboloid_is_exact_inside_and_zero_outside() {
        let grid = Grid { x: axis(2.0, 9), y: axis(1.5, 7) };
        let f = |x: f64, y: f64| 10.0 - x * x + 0.5 * x * y - y * y;
        let rate = Array2::from_shape_fn((7, 9), |(r, c)| {
            f(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
        });
        let tif = Tif::new(grid, rate).unwrap();
        for (x, y) in [(0.1, 0.2), (-1.99, 1.45), (2.0, 1.5), (-2.0, -1.5), (1.93, -1.31)] {
            // The interpolation is exact for these polynomials: rounding of 10 nm/s.
            assert!((tif.rate_at(x, y) - f(x, y)).abs() < 1e-12, "{x} {y}");
        }
        assert_eq!(tif.rate_at(2.0001, 0.0), 0.0);
        assert_eq!(tif.rate_at(0.0, -1.5001), 0.0);
    }

    #[test]
    fn bad_tifs_are_refused() {
        let grid = Grid { x: axis(1.0, 3), y: axis(1.0, 3) };
        let message = |m| Tif::new(grid, m).unwrap_err().to_string();
        assert!(message(Array2::zeros((3, 3))).contains("no positive rate"));
        assert!(message(Array2::from_elem((3, 3), -1.0)).contains("no positive rate"));
        let mut m = Array2::ones((3, 3));
        m[[2, 1]] = -0.5;
        assert!(message(m.clone()).contains("rate_nm_per_s[2, 1]: is -0.5"));
        m[[2, 1]] = f64::NAN;
        assert!(message(m).contains("is NaN"));
        assert!(message(Array2::ones((2, 3))).contains("(2, 3)"));
    }

    /// A Gaussian of peak 1 with a full width at half maximum of 1 mm, on n x n samples of +-1.6
    /// mm, plus normal noise. The noise is made of sums of twelve uniform numbers, averaged over
    /// `block` x `block` samples.
    fn noisy_spot(n: usize, sigma: f64, block: usize, seed: u64) -> (Grid, Array2<f64>) {
        let x = axis(1.6, n);
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        let mut uniform = || {
            // xorshift64*
            state ^= state >> 12;
            state ^= state << 25;
            state ^= state >> 27;
            (state.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11) as f64 / (1_u64 << 53) as f64
        };
        let size = n + block - 1;
        let white = Array2::from_shape_simple_fn((size, size), || {
            (0..12).map(|_| uniform()).sum::<f64>() - 6.0
        });
        let rate = Array2::from_shape_fn((n, n), |(r, c)| {
            // The mean of block^2 numbers, scaled to the variance of one.
            let normal = white.slice(s![r..r + block, c..c + block]).sum() / block as f64;
            let square = x.coordinate_mm(r).powi(2) + x.coordinate_mm(c).powi(2);
            (-4.0 * std::f64::consts::LN_2 * square).exp() + sigma * normal
        });
        (Grid { x, y: x }, rate)
    }

    #[test]
    fn noise_is_not_refused_and_keeps_the_volume() {
        // pi / (4 ln 2) mm^2 of the whole Gaussian, less its part beyond 1.6 mm: erf(1.6 sqrt(4 ln
        // 2))^2 = 1 - 3.3e-4.
        let volume = std::f64::consts::PI / (4.0 * std::f64::consts::LN_2);
        // White noise, and the correlated noise of instruments.
        for (sigma, block) in
            [0.005, 0.01, 0.02].into_iter().flat_map(|s| [1, 3, 5].map(|b| (s, b)))
        {
            for n in [41, 61, 81] {
                let vrr = |seed| {
                    let (grid, rate) = noisy_spot(n, sigma, block, seed);
                    let tif =
                        Tif::new(grid, rate).unwrap_or_else(|e| panic!("{sigma} {block} {n}: {e}"));
                    tif.vrr_nm_mm2_per_s() / volume - 1.0
                };
                let draws: Vec<f64> = (0..200).map(vrr).collect();
                let mean = draws.iter().sum::<f64>() / 200.0;
                let scatter =
                    (draws.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 199.0).sqrt();
                // The mean of 200 draws scatters by 7 % of one.
                assert!(
                    mean.abs() < 0.3 * scatter + 3.3e-4,
                    "{sigma} {block} {n}: {mean} {scatter}"
                );
            }
        }
    }

    #[test]
    fn width_of_a_gaussian() {
        let axis = Axis::new(-5.0, 0.1, 101).unwrap();
        let grid = Grid { x: axis, y: axis };
        let sigma = 1.7;
        let rate = Array2::from_shape_fn((101, 101), |(r, c)| {
            let square = axis.coordinate_mm(c).powi(2) + axis.coordinate_mm(r).powi(2);
            8.0 * (-square / (2.0 * sigma * sigma)).exp()
        });
        let width = Tif::new(grid, rate).unwrap().half_maximum_width_mm();
        let exact = 2.0 * (2.0 * std::f64::consts::LN_2).sqrt() * sigma;
        // Counting lattice points in a circle of 40 px: about one row in 500.
        assert!((width / exact - 1.0).abs() < 5e-3, "{width} {exact}");
    }

    #[test]
    fn noise_after_a_taper_is_not_refused() {
        // A taper makes the border zero and leaves the noise of the inner samples.
        for seed in 0..200 {
            let (grid, mut rate) = noisy_spot(61, 0.02, 1, seed);
            for ((r, c), v) in rate.indexed_iter_mut() {
                let edge = (grid.x.coordinate_mm(c).abs().max(grid.y.coordinate_mm(r).abs()) / 1.6
                    - 0.85)
                    .max(0.0)
                    / 0.15;
                *v *= 0.5 * (1.0 + (std::f64::consts::PI * edge).cos());
            }
            Tif::new(grid, rate).unwrap();
        }
    }

    #[test]
    fn a_wrong_sign_or_a_negative_lobe_is_refused_under_noise() {
        for (seed, sigma) in (0..60).zip([0.0, 0.005, 0.01, 0.02].into_iter().cycle()) {
            let (grid, rate) = noisy_spot(61, sigma, 1, seed);
            let e = Tif::new(grid, -&rate).unwrap_err().to_string();
            assert!(e.contains("check the sign") || e.contains("no positive rate"), "{e}");
            // A lobe of 8 % of the peak and ten times the noise, where the spot is 1 % of its peak.
            let depth = 0.08 + 10.0 * sigma;
            let lobed = Array2::from_shape_fn(rate.dim(), |(r, c)| {
                let square =
                    (grid.x.coordinate_mm(c) - 1.3).powi(2) + grid.y.coordinate_mm(r).powi(2);
                rate[[r, c]] - depth * (-square / 0.09).exp()
            });
            let e = Tif::new(grid, lobed).unwrap_err().to_string();
            assert!(e.contains("lowest rate that noise of"), "{sigma}: {e}");
        }
    }
}
