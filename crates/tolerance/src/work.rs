//! The plan and the errors: what a run with any of them leaves, by simulation.

use ndarray::Array2;
use planish_numerics::orthogonal::legendre;
use planish_simulate::{Plan, Settings as Simulation};
use planish_types::{Axis, Invalid, Surface, Tif, Trajectory, text::significant};

use crate::{
    deviation::Deviation,
    inner::Inner,
    motion::Motion,
    process::{Effect, Noise, Process, Scalar},
    settings::Free,
};

/// A displacement of the tool beyond the size of the TIF is no error of this process.
const LARGEST_DISPLACEMENT: f64 = 1.0;

/// What the errors are, apart from what they do.
pub struct Work<'a> {
    /// What errors change is computed with it.
    pub tif: &'a Tif,
    plan: Plan<'a>,
    /// What runs without an error with that TIF removes.
    removal: Array2<f64>,
    pub inner: Inner,
    pub motion: Motion,
    pub process: &'a Process,
    /// P (h - R).
    pub nominal: Array2<f64>,
}

impl<'a> Work<'a> {
    /// Of a plan with the TIF `tif`, whose errors are computed with `moved`, both of this width.
    pub fn new(
        trajectory: &Trajectory,
        tif: &Tif,
        moved: &'a Tif,
        desired: &'a Surface,
        process: &'a Process,
        free: Free,
        width: f64,
    ) -> Result<Self, Invalid> {
        let motion = Motion::new(trajectory, 0.5 * width)?;
        let inner = Inner::new(desired, free, width);
        let executed =
            Plan::new(tif, desired.grid(), Simulation::Gridded)?.removal_nm(trajectory)?.0;
        let nominal = inner.judged(desired.height_nm() - &executed);
        let plan = Plan::new(moved, desired.grid(), Simulation::Gridded)?;
        let unchanged = Deviation::default().trajectory(&motion, desired.grid())?;
        let removal = plan.removal_nm(&unchanged)?.0;
        let work = Self { tif: moved, plan, removal, inner, motion, process, nominal };
        work.check_sizes(width)?;
        Ok(work)
    }

    /// RMS of a masked map, nm.
    pub fn rms(&self, judged: &Array2<f64>) -> f64 {
        self.inner.dot(judged, judged).sqrt()
    }

    /// Half the diagonal of the map, mm.
    fn reach_mm(&self) -> f64 {
        let size = [self.inner.grid.x, self.inner.grid.y].map(|a| a.end_mm() - a.start_mm());
        0.5 * size[0].hypot(size[1])
    }

    /// How far the tool moves, in mm (a TIF's change: times its width), per size of an effect.
    pub fn displacement_per_size(&self, effect: Scalar, width: f64) -> f64 {
        match effect {
            Scalar::RateScale | Scalar::RateDrift | Scalar::RateWarmUp { .. } => 0.0,
            Scalar::OffsetX | Scalar::OffsetY | Scalar::Backlash => 1.0,
            Scalar::Rotation | Scalar::Magnification | Scalar::Shear => self.reach_mm(),
            Scalar::TifWidth | Scalar::TifEllipticity | Scalar::TifRotation => width,
            Scalar::VelocityLag | Scalar::ServoFirstOrder | Scalar::ServoSecondOrder { .. } => {
                self.motion.largest_speed_mm_per_s()
            }
        }
    }

    /// Refuses displacements that are no errors, and fixed sizes of which the first order has no meaning.
    fn check_sizes(&self, width: f64) -> Result<(), Invalid> {
        let [x, y] = self.tif.half_size_mm();
        let largest = LARGEST_DISPLACEMENT * 2.0 * x.max(y);
        for (i, error) in self.process.errors.iter().enumerate() {
            let moved = match error.effect {
                Effect::Scalar(effect) => self.displacement_per_size(effect, width) * error.size,
                Effect::Noise(Noise::Position) => error.size,
                _ => 0.0,
            };
            if moved.abs() > largest {
                let stated = &error.stated;
                let problem = format!(
                    "{} of {} {} moves the tool by {moved:.3e} mm, and the TIF is {largest:.3e} mm wide",
                    stated.kind.name(),
                    stated.size,
                    stated.unit
                );
                let most = significant(largest / moved.abs() * stated.size.abs(), 3);
                let remedy = format!(
                    "give at most {most} {}: an error moves the tool by less than the TIF is wide",
                    stated.unit
                );
                return Err(Invalid::at("errors", i, problem, remedy));
            }
        }
        Ok(())
    }

    /// The residual of a run.
    pub fn residual(&self, run: &Deviation) -> Result<Array2<f64>, Invalid> {
        let trajectory = run.trajectory(&self.motion, &self.inner.grid)?;
        let removal = match run.tif(self.tif)? {
            Some(tif) => {
                Plan::new(&tif, &self.inner.grid, Simulation::Gridded)?.removal_nm(&trajectory)?.0
            }
            None => self.plan.removal_nm(&trajectory)?.0,
        };
        let mut more = &self.removal - &removal;
        if let Some(map) = &run.map_nm {
            more += map;
        }
        Ok(&self.nominal + &self.inner.judged(more))
    }

    /// Legendre polynomials up to a total degree, the constant left out, of RMS one over the rectangle.
    pub fn low_order(&self, degree: usize) -> Vec<Array2<f64>> {
        let (x, y) = (&self.inner.grid.x, &self.inner.grid.y);
        let table = |a: &Axis| -> Vec<Vec<f64>> {
            let half = 0.5 * (a.end_mm() - a.start_mm());
            let of = |i: usize| {
                let mut p = vec![0.0; degree + 1];
                let u = if half > 0.0 { (a.at(i) - a.start_mm()) / half - 1.0 } else { 0.0 };
                legendre(u, &mut p);
                p
            };
            (0..a.len()).map(of).collect()
        };
        let (px, py) = (table(x), table(y));
        let pairs = (1..=degree).flat_map(|d| (0..=d).map(move |i| (d - i, i)));
        pairs
            .map(|(i, j)| {
                let scale = ((2 * i + 1) as f64 * (2 * j + 1) as f64).sqrt();
                Array2::from_shape_fn((y.len(), x.len()), |(r, c)| scale * px[c][i] * py[r][j])
            })
            .collect()
    }

    /// Index, kind and size of the noise along the run.
    pub fn noises(&self) -> Vec<(usize, Noise, f64)> {
        let each = self.process.errors.iter().enumerate();
        each.filter_map(|(i, e)| match e.effect {
            Effect::Noise(noise) if e.size > 0.0 => Some((i, noise, e.size)),
            _ => None,
        })
        .collect()
    }
}
