//! Deviations of a run from its plan: motion, TIF and map with their errors. A piece is a short part of the motion; a
//! stay is the part that serves one dwell point without interruption.
//!
//! A rate that differs from one is time in the place of rate: a piece of the motion that takes r times as
//! long, along the same curve, removes r times as much. So every deviation of the run is a trajectory that the
//! simulator executes as it is.
//!
//! The order is that of the machine. The planner slows down at the corners of the commanded motion and smooths it. The
//! servo follows this motion, play adds to it, and every dwell point is misplaced. Then the machine's axes are turned, scaled and shifted against the map, and the rate acts there.

use ndarray::Array2;
use planish_types::{Grid, Invalid, Tif, Trajectory, outcome::virtual_machine::Truth};

use crate::{
    error_budget::{Distribution, Effect, ErrorBudget, Scalar},
    motion::{Motion, MotionPiece},
    planner::Planner,
    play::with_play,
    servo::Servo,
};

/// All errors of one run; none by default.
#[derive(Clone, Debug, Default)]
pub struct Deviation {
    /// Relative error of the rate throughout the run, dimensionless.
    rate: f64,
    /// Relative rise of the rate from the start to the end of the run.
    drift: f64,
    /// Time constant, s, and relative amount of each warm-up of the rate.
    warm_up: Vec<(f64, f64)>,
    offset_mm: [f64; 2],
    rotation_rad: f64,
    magnification: f64,
    shear: f64,
    tif_width: f64,
    tif_ellipticity: f64,
    tif_diagonal_ellipticity: f64,
    tif_rotation_rad: f64,
    corners: Vec<Planner>,
    smoothing: Vec<Planner>,
    servos: Vec<Servo>,
    backlash_mm: f64,
    /// Relative deviation of the rate by noise, its mean over every piece of the motion; empty if there is none.
    pub rate_of_piece: Vec<f64>,
    /// Displacement [x, y] of the tool in every stay, mm; empty if there is none.
    pub place_of_stay_mm: Vec<[f64; 2]>,
    /// Error of the time of every stay, s; empty if there is none.
    pub time_of_stay_s: Vec<f64>,
    /// Change of the residual by the errors of the map, shape (ny, nx), nm; `None` without such errors.
    pub map_nm: Option<Array2<f64>>,
}

/// Reason why some tools have no ellipticity along axes of the part, for messages.
pub const TURNS: &str = "turns with the azimuth, and its ellipticity turns with it, which kernels along fixed axes do \
                         not follow";

/// Returns true if the tool can have an ellipticity along fixed axes of the part: its spot does not turn with the
/// azimuth.
pub fn has_one_ellipse(tif: &Tif) -> bool {
    tif.variation().is_none_or(|v| v.azimuth_weights().is_none())
}

/// Refuses a tool that turns with the direction of its motion. If the spot turns with the azimuth, refuses an error
/// budget with ellipticities of a size other than 0.
pub fn check_tool(process: &ErrorBudget, tif: &Tif) -> Result<(), Invalid> {
    tif.same_in_all_directions("a simulation with errors of the process")?;
    for (i, error) in process.errors.iter().enumerate() {
        let is_ellipse = matches!(
            error.effect,
            Effect::Scalar(Scalar::TifEllipticity | Scalar::TifDiagonalEllipticity)
        );
        if is_ellipse && error.size != 0.0 && !has_one_ellipse(tif) {
            let problem = format!("is a {}, and the tool {TURNS}", error.stated.kind.name());
            return Err(Invalid::at_index(
                "errors",
                i,
                problem,
                "leave it out, or give a size of 0",
            ));
        }
    }
    Ok(())
}

impl Deviation {
    /// Returns the response of planner and axes that is the same in every run of `process`: its errors `corner_speed`,
    /// `smoothing`, `velocity_lag`, `servo_first_order` and `servo_second_order` of a fixed size other than 0, in the
    /// order of the file.
    pub fn servos_of(process: &ErrorBudget) -> Self {
        let mut run = Self::default();
        for error in &process.errors {
            if let Effect::Scalar(effect) = error.effect
                && effect.is_a_lag()
                && error.stated.distribution == Distribution::Fixed
                && error.size != 0.0
            {
                run.add(effect, error.size);
            }
        }
        run
    }

    /// Returns the number of models of planner and servo through which the commanded motion passes, one after the
    /// other.
    pub fn servo_count(&self) -> usize {
        self.corners.len() + self.smoothing.len() + self.servos.len()
    }

    /// Adds an error with this effect to those that are already there. `size` is a fraction, or in mm, rad or s, as its
    /// kind has it.
    pub fn add(&mut self, effect: Scalar, size: f64) {
        match effect {
            Scalar::RateScale => self.rate += size,
            Scalar::RateDrift => self.drift += size,
            Scalar::RateWarmUp { time_constant_s } => self.warm_up.push((time_constant_s, size)),
            Scalar::OffsetX => self.offset_mm[0] += size,
            Scalar::OffsetY => self.offset_mm[1] += size,
            Scalar::Rotation => self.rotation_rad += size,
            Scalar::Magnification => self.magnification += size,
            Scalar::Shear => self.shear += size,
            Scalar::TifWidth => self.tif_width += size,
            Scalar::TifEllipticity => self.tif_ellipticity += size,
            Scalar::TifDiagonalEllipticity => self.tif_diagonal_ellipticity += size,
            Scalar::TifRotation => self.tif_rotation_rad += size,
            Scalar::VelocityLag => self.servos.push(Servo::Lag { lag_s: size }),
            Scalar::ServoFirstOrder => self.servos.push(Servo::FirstOrder { lag_s: size }),
            Scalar::ServoSecondOrder { damping_ratio } => {
                self.servos.push(Servo::SecondOrder { lag_s: size, damping_ratio });
            }
            Scalar::Smoothing => self.smoothing.push(Planner::Smoothing { window_s: size }),
            Scalar::CornerSpeed { acceleration_mm_per_s2 } => {
                self.corners.push(Planner::Corners { step_mm_per_s: size, acceleration_mm_per_s2 });
            }
            Scalar::Backlash => self.backlash_mm += size,
        }
    }

    /// Returns the TIF of the tool with these errors; `None` if none of them changes its width, ellipticity or
    /// rotation.
    ///
    /// The tool is wider, longer or rotated in the plane of the part, about the centroid c of the mean tool. S is the
    /// stretch, followed by the rotation; u is an offset from c, and p the position of a tool that varies over the
    /// part:
    ///
    /// ```text
    /// K'(p + c + u; p) = K(p + c + S^-1 u; p) / det S = sum_k a_k(p) phi_k(c + S^-1 u) / det S
    /// ```
    ///
    /// so that every kernel phi_k changes in the same way. Its volume is kept, and so is that of the tool at every
    /// place. The axes of a spot that turns with the azimuth turn with it. A width and a rotation act alike along all
    /// of them; an ellipticity does not, and is refused ([`has_one_ellipse`]).
    pub fn tif(&self, tif: &Tif) -> Result<Option<Tif>, Invalid> {
        let shape = [self.tif_width, self.tif_ellipticity, self.tif_diagonal_ellipticity];
        if shape == [0.0; 3] && self.tif_rotation_rad == 0.0 {
            return Ok(None);
        }
        if [shape[1], shape[2]] != [0.0; 2] && !has_one_ellipse(tif) {
            let remedy = "leave tif_ellipticity and tif_diagonal_ellipticity out";
            return Err(Invalid::whole("tif", TURNS, remedy));
        }
        // R'(c + u) = R(c + S^-1 u) about the centroid c, so that the tool stays where it removes; S is a rotation
        // after the stretch     w [[1 + e/2, d/2], [d/2, 1 - e/2]];    the volume is kept.
        let w = 1.0 + shape[0];
        let e = 0.5 * shape[1];
        let d = 0.5 * shape[2];
        let (sine, cosine) = self.tif_rotation_rad.sin_cos();
        let determinant = w * (1.0 - e * e - d * d);
        let inverse = [
            [(1.0 - e) / determinant, -d / determinant],
            [-d / determinant, (1.0 + e) / determinant],
        ];
        let grid = tif.grid();
        let [cx, cy] = tif.centroid_mm();
        let changed = |kernel: &Tif| {
            Array2::from_shape_fn(grid.shape(), |(r, c)| {
                let x = grid.x.coordinate_mm(c) - cx;
                let y = grid.y.coordinate_mm(r) - cy;
                let u = [cosine * x + sine * y, cosine * y - sine * x];
                let [dx, dy] = inverse.map(|row| row[0] * u[0] + row[1] * u[1]);
                kernel.rate_at(cx + dx, cy + dy)
            })
        };
        let volume = tif.rate_nm_per_s().sum() / changed(tif).sum();
        tif.with_kernels(|kernel| Ok((*grid, changed(kernel) * volume))).map(Some)
    }

    /// Computes the motion with its errors, in the coordinates of the map with the pixels `grid`. Its rate factors hold
    /// the errors of the rate.
    ///
    /// # Errors
    ///
    /// Fails if nothing of the motion is left, because the errors of its rate take away the time of every piece.
    pub fn trajectory(&self, motion: &Motion, grid: &Grid) -> Result<Trajectory, Invalid> {
        let mut pieces = motion.pieces.clone();
        // Rates first: they belong to the times of the plan.
        let mut rate: Vec<f64> =
            pieces.iter().map(|p| 1.0 + self.rate_at(p, motion.total_s)).collect();
        for (r, more) in rate.iter_mut().zip(&self.rate_of_piece) {
            *r += more;
        }
        if !self.time_of_stay_s.is_empty() {
            for (r, p) in rate.iter_mut().zip(&pieces) {
                *r *= 1.0 + self.time_of_stay_s[p.stay] / motion.stay_s[p.stay];
            }
        }
        // What the beam did, where a log has it, is a factor of all of them.
        rate.iter_mut().zip(&pieces).for_each(|(r, p)| *r *= p.rate_factor);
        let mut origin: Vec<usize> = (0..pieces.len()).collect();
        for planner in self.corners.iter().chain(&self.smoothing) {
            (pieces, origin) = planner.follow(&pieces, &origin);
        }
        for servo in &self.servos {
            (pieces, origin) = servo.follow(&pieces, &origin);
        }
        if self.backlash_mm != 0.0 {
            (pieces, origin) = with_play(&pieces, &origin, self.backlash_mm);
        }
        if !self.place_of_stay_mm.is_empty() {
            for p in &mut pieces {
                let place = self.place_of_stay_mm[p.stay];
                p.coefficient_mm.iter_mut().zip(place).for_each(|(c, d)| c[0] += d);
            }
        }
        let middle = [&grid.x, &grid.y].map(|a| 0.5 * (a.start_mm() + a.end_mm()));
        let (sine, cosine) = self.rotation_rad.sin_cos();
        let m = 1.0 + self.magnification;
        let mut breaks = vec![0.0];
        let mut coefficients = Vec::new();
        let mut tool_on = Vec::new();
        for (p, from) in pieces.iter().zip(origin) {
            let [mut x, mut y] = p.coefficient_mm;
            x[0] -= middle[0];
            y[0] -= middle[1];
            let mut c = [[0.0; 4]; 2];
            // A rate r is the time r: u = r u', so that the k-th coefficient is divided by r^k.
            let r = rate[from];
            let mut power = 1.0;
            for k in 0..4 {
                let a = m * (x[k] + self.shear * y[k]);
                let b = m * y[k];
                c[0][k] = (cosine * a - sine * b) / power;
                c[1][k] = (sine * a + cosine * b) / power;
                power *= r;
            }
            for axis in 0..2 {
                c[axis][0] += middle[axis] + self.offset_mm[axis];
            }
            // A run removes nothing in a time that noise takes away altogether, or with the beam off.
            let removes = r > 0.0;
            let end = breaks[breaks.len() - 1] + if removes { r * p.duration_s } else { 0.0 };
            if removes && end > breaks[breaks.len() - 1] {
                breaks.push(end);
                coefficients.push(c);
                tool_on.push(p.tool_on);
            }
        }
        let index = vec![None; tool_on.len()];
        Trajectory::new(breaks, coefficients, tool_on, index)
    }

    /// Returns the errors that act throughout the run, for the record of the truth.
    pub fn truth(&self) -> Truth {
        Truth {
            rate_scale: self.rate,
            offset_x_mm: self.offset_mm[0],
            offset_y_mm: self.offset_mm[1],
            rotation_rad: self.rotation_rad,
            magnification: self.magnification,
            shear: self.shear,
            tif_width: self.tif_width,
            tif_ellipticity: self.tif_ellipticity,
            tif_diagonal_ellipticity: self.tif_diagonal_ellipticity,
            tif_rotation_rad: self.tif_rotation_rad,
        }
    }

    /// Returns the mean over a piece of the relative deviation of the rate by its scale, drift and warm-ups, without
    /// its noise. `total_s` is the duration of the run.
    pub fn rate_at(&self, p: &MotionPiece, total_s: f64) -> f64 {
        // d (t / T - 1/2), and -a exp(-t / tau)
        let middle = (p.start_s + 0.5 * p.duration_s) / total_s - 0.5;
        let warm_up = self.warm_up.iter().map(|(tau, a)| {
            let gone = -(-p.duration_s / tau).exp_m1();
            -a * (-p.start_s / tau).exp() * gone * tau / p.duration_s
        });
        self.rate + self.drift * middle + warm_up.sum::<f64>()
    }
}
