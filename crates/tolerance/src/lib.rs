//! What the errors of a process add to the residual of a plan.
//!
//! ```text
//! e = P (h - R) = e0 - sum_i eta_i f_i - n
//! ```
//!
//! h is the desired removal, R what is executed, P removes what is free (a piston, or a plane). To first order
//! every error that one number decides adds a field f_i, the derivative of the executed removal: one pair of
//! simulations with the error of opposite signs ([`deviation`]). Errors of their own in every piece of the
//! motion, and fluctuations in time, add a Gaussian field n, whose covariance is known from the removal of the
//! pieces ([`noise`]). Then
//!
//! * what an error adds alone is the RMS of its field, and the part of it that the tool reaches ([`reach`]);
//! * the residual's distribution comes from draws in as many dimensions as there are errors ([`draws`]).
//!
//! Whether the first order is enough is measured: every error is simulated once as it is, and a sample of runs
//! with all of them. Where an error departs from its first order by more than [`LARGEST_DEPARTURE`], and not by
//! less than [`SEEN`], runs are simulated in the place of both.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | e0 | `nominal` | nm |
//! | f_i | `Linear::field` | nm per size |
//! | eta_i | `draws::draw` | 1 |
//! | n | `noise::Columns::change` | nm |

pub mod deviation;
pub mod draws;
pub mod inner;
pub mod motion;
pub mod noise;
pub mod process;
pub mod reach;
pub mod servo;
pub mod tool;

use nalgebra::{DMatrix, DVector};
use ndarray::Array2;
use planish_numerics::orthogonal::legendre;
use planish_simulate::{Plan, Settings as Simulation};
use planish_types::{Axis, Invalid, Surface, Tif, Trajectory, budget};
use rand_distr::{Distribution as _, StandardNormal};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    deviation::Deviation,
    draws::{Model, Term, draw, orthonormal, quantile, stream},
    inner::Inner,
    motion::Motion,
    noise::{Columns, Response, sample},
    process::{Distribution, Effect, Noise, Process, ProcessError, Scalar},
    reach::Reach,
    tool::{smooth, width_mm},
};

/// What nobody asks for: it is not part of the residual.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Free {
    /// The mean.
    Piston,
    /// The best plane.
    Plane,
}

/// How to find out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// What is not part of the residual.
    pub free: Free,
    /// Runs that are drawn to first order.
    pub draws: usize,
    /// Runs that are simulated, to check the first order.
    pub simulated_runs: usize,
    /// Whether the TIF that errors move is that of the plan, with its noise and its border, and not [`tool`]'s.
    pub tif_as_sampled: bool,
    /// Random seed.
    pub seed: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            free: Free::Piston,
            draws: 100_000,
            simulated_runs: 8,
            tif_as_sampled: false,
            seed: 1,
        }
    }
}

/// Largest departure of an error from its first order, as a part of what it adds; above, it is simulated, unless
/// the departure is less than [`SEEN`].
pub const LARGEST_DEPARTURE: f64 = 0.1;

/// A departure that is seen, as a part of the RMS that is expected: a smaller one changes that by 5e-5 of it.
pub const SEEN: f64 = 0.01;

/// Runs from which the line of an error is taken where the first order is not enough.
const RUNS_OF_ONE_ERROR: usize = 32;

/// Runs from which the distribution is taken where the first order is not enough.
const RUNS_OF_ALL: usize = 200;

/// Draws from which it is known what 95 % of the runs are below without one of the errors.
const DRAWS_WITHOUT_ONE: usize = 10_000;

/// Most draws and simulated runs: a day of work is not meant.
const MOST_DRAWS: usize = 100_000_000;
const MOST_SIMULATED_RUNS: usize = 100_000;

/// Pairs of simulated deviations move the tool by this part of the width of the TIF, or change it by as much:
/// the third order, which does not cancel, is 1e-4 / 6 of the first.
const STEP: f64 = 0.01;

/// A displacement of the tool beyond the size of the TIF is no error of this process.
const LARGEST_DISPLACEMENT: f64 = 1.0;

/// Levels at which the distribution is stored.
pub const LEVELS: usize = 201;

/// Fields from which trace(S_perp^2) is estimated: 1128 pairs.
const POOL: usize = 48;

/// What an error adds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Line {
    /// Its kind.
    pub kind: String,
    /// Its size as stated.
    pub size: f64,
    /// Unit of the size.
    pub unit: String,
    /// How it scatters.
    pub distribution: Distribution,
    /// Where the figure comes from.
    pub note: String,
    /// RMS over pixels and runs of what it adds alone, nm.
    pub adds_rms_nm: f64,
    /// The part of it at frequencies that the tool corrects.
    pub reached_rms_nm: f64,
    /// The part of it at frequencies that the tool does not correct.
    pub unreached_rms_nm: f64,
    /// RMS difference between what one run with the error of this size adds and its first order, nm.
    pub departs_by_rms_nm: f64,
    /// Whether the line is that of simulated runs, because the departure is too large.
    pub simulated: bool,
}

/// A run with all errors, simulated, and as the first order has it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Pair {
    /// RMS of the simulated run, nm.
    pub simulated_rms_nm: f64,
    /// RMS to first order, nm.
    pub first_order_rms_nm: f64,
}

/// The distribution of the residual's RMS over the runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Quantiles {
    /// Half of the runs are below, nm.
    pub median_nm: f64,
    /// 95 % of the runs are below, nm.
    pub below_95_percent_nm: f64,
    /// 95 % of the runs are between these, as many above as below, nm.
    pub interval_95_percent_nm: [f64; 2],
}

/// The error without which the residual that 95 % of the runs are below is least.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct First {
    /// Its index among the errors.
    pub index: usize,
    /// Its kind.
    pub kind: String,
    /// Without it 95 % of the runs are below this, nm (first order).
    pub without_it_95_percent_nm: f64,
}

/// What the process adds.
#[derive(Clone, Debug, Serialize)]
pub struct Tolerance {
    /// Name of the process.
    pub process: String,
    /// RMS of the residual of the plan, nm.
    pub nominal_rms_nm: f64,
    /// sqrt of the mean over runs of the mean square, nm (first order).
    pub expected_rms_nm: f64,
    /// The distribution.
    pub residual: Quantiles,
    /// Whether the distribution is that of simulated runs.
    pub simulated: bool,
    /// An entry per error of the process.
    pub errors: Vec<Line>,
    /// What to improve first; none where no error adds anything.
    pub first: Option<First>,
    /// Runs that were simulated.
    pub runs: Vec<Pair>,
    /// Largest relative difference between the two RMS of these runs.
    pub largest_difference: f64,
    /// How many of the simulated runs are in the interval of 95 %.
    pub within_interval: usize,
    /// The distribution: parts of the runs, and the RMS they are below, nm.
    #[serde(skip)]
    pub levels: Vec<(f64, f64)>,
    /// Standard deviation over the runs of the residual of every pixel, nm; NaN where invalid.
    #[serde(skip)]
    pub deviation_nm: Array2<f64>,
}

/// A field that one number decides, and what it belongs to.
struct Linear {
    error: usize,
    distribution: Distribution,
    /// At size one.
    field: Array2<f64>,
    /// Its size.
    size: f64,
}

/// What the errors are, apart from what they do.
struct Work<'a> {
    /// What errors change is computed with it.
    tif: &'a Tif,
    plan: Plan<'a>,
    /// What runs without an error with that TIF removes.
    removal: Array2<f64>,
    inner: Inner,
    motion: Motion,
    process: &'a Process,
    /// P (h - R).
    nominal: Array2<f64>,
}

/// What `process` adds to the residual of `trajectory` on `desired`.
pub fn tolerance(
    trajectory: &Trajectory,
    tif: &Tif,
    desired: &Surface,
    process: &Process,
    settings: &Settings,
) -> Result<Tolerance, Invalid> {
    check(settings)?;
    let width = width_mm(tif);
    let motion = Motion::new(trajectory, 0.5 * width)?;
    let inner = Inner::new(desired, settings.free, width);
    let executed = Plan::new(tif, desired.grid(), Simulation::Gridded)?.removal_nm(trajectory)?.0;
    let nominal = inner.judged(desired.height_nm() - &executed);
    let smooth = if settings.tif_as_sampled { tif.clone() } else { smooth(tif, width)? };
    let tif = &smooth;
    let plan = Plan::new(tif, desired.grid(), Simulation::Gridded)?;
    let unchanged = Deviation::default().trajectory(&motion, desired.grid())?;
    let removal = plan.removal_nm(&unchanged)?.0;
    let work = Work { tif, plan, removal, inner, motion, process, nominal };
    work.check_sizes(width)?;

    // f_i
    let linear = work.linear(width)?;
    let maps: Vec<&Array2<f64>> =
        [&work.nominal].into_iter().chain(linear.iter().map(|l| &l.field)).collect();
    let n = maps.len();
    let rows: Vec<Vec<f64>> = (0..n)
        .into_par_iter()
        .map(|i| (0..=i).map(|j| work.inner.dot(maps[i], maps[j])).collect())
        .collect();
    let gram = DMatrix::from_fn(n, n, |i, j| rows[i.max(j)][i.min(j)]);
    let (coordinates, basis) = orthonormal(&gram);

    // n
    let on_cells: Vec<Vec<f64>> = maps.iter().map(|m| work.inner.to_cells(m)).collect();
    let basis_on_cells: Vec<Vec<f64>> = basis
        .column_iter()
        .map(|b| {
            let mut field = vec![0.0; work.inner.cells.weight.len()];
            for (map, b) in on_cells.iter().zip(b.iter()) {
                field.iter_mut().zip(map).for_each(|(v, m)| *v += b * m);
            }
            work.inner.project_on_cells(&mut field);
            field
        })
        .collect();
    let reach = Reach::new(&work.inner, tif, width);
    let noises = work.noises();
    let displaced = noises.iter().any(|(_, n, _)| *n == Noise::Position);
    let columns = match noises.is_empty() {
        true => None,
        false => Some(Columns::new(
            &work.motion,
            &work.inner,
            tif,
            reach.on_cells(&work.inner),
            basis_on_cells.clone(),
            displaced,
        )?),
    };
    let responses: Vec<(usize, f64, Response)> = match &columns {
        Some(columns) => {
            noises.iter().map(|(i, noise, size)| (*i, *size, columns.response(*noise))).collect()
        }
        None => Vec::new(),
    };

    let departures = work.departures(&linear, columns.as_ref(), settings.seed)?;
    let mut lines = work.lines(&linear, &responses, &reach, &departures);
    // The distribution
    let column = |i: usize| DVector::from_column_slice(coordinates.column(i).as_slice());
    let terms = |without: Option<usize>| -> Vec<Term> {
        let of = |(i, l): (usize, &Linear)| Term {
            distribution: l.distribution,
            coordinates: column(i + 1) * if Some(l.error) == without { 0.0 } else { l.size },
        };
        linear.iter().enumerate().map(of).collect()
    };
    let white = |without: Option<usize>| -> f64 {
        let each = process
            .errors
            .iter()
            .enumerate()
            .filter(|(i, e)| e.effect == Effect::MapNoise && Some(*i) != without);
        each.map(|(_, e)| e.size * e.size).sum()
    };
    let free = work.inner.cells.free.len() as f64;
    let pool = columns.as_ref().map(|c| work.pool(c, &basis_on_cells, settings.seed));
    let dimension = coordinates.nrows();
    let model = |without: Option<usize>| -> Model {
        let mut noise = DMatrix::zeros(dimension, dimension);
        let (mut all, mut total) = (0.0, 0.0);
        for (i, size, response) in &responses {
            let square = size * size;
            total += square * response.mean_square;
            if Some(*i) != without {
                noise += &response.covariance * square;
                all += square * response.mean_square;
            }
        }
        let smooth = (all - noise.trace()).max(0.0);
        // trace(S_perp^2) of the whole noise, for what is left of it
        let part = if total > 0.0 { all / total } else { 0.0 };
        let squares = pool.unwrap_or(0.0) * part * part;
        // White noise of the map: m numbers, less the free terms, of the same variance on every pixel
        let (white, m) = (white(without), work.inner.count);
        for k in 0..dimension {
            noise[(k, k)] += white / m;
        }
        let pixels = (m - free - dimension as f64).max(0.0);
        Model {
            nominal: column(0),
            terms: terms(without),
            rest: smooth + white * pixels / m,
            rest_variance: 2.0
                * (squares + 2.0 * white / m * smooth + white * white * pixels / (m * m)),
            noise,
        }
    };
    let expected = |model: &Model| {
        let mut e = model.nominal.clone();
        let mut square = model.noise.trace() + model.rest;
        for term in &model.terms {
            match term.distribution {
                Distribution::Fixed => e -= &term.coordinates,
                Distribution::Normal => square += term.coordinates.norm_squared(),
                Distribution::Uniform => square += term.coordinates.norm_squared() / 3.0,
            }
        }
        e.norm_squared() + square
    };
    let drawn = |model: &Model| {
        let mut rms = model.draw(settings.draws, settings.seed);
        rms.sort_unstable_by(f64::total_cmp);
        rms
    };
    let whole = model(None);
    let expected_rms_nm = expected(&whole).sqrt();
    let departs = |line: &Line| {
        line.departs_by_rms_nm > LARGEST_DEPARTURE * line.adds_rms_nm
            && line.departs_by_rms_nm > SEEN * expected_rms_nm
    };
    let any_departs = lines.iter().any(departs);
    for (i, line) in lines.iter_mut().enumerate().filter(|(_, l)| departs(l)) {
        work.simulate_line(i, line, &reach, settings.seed)?;
    }
    let mut rms = drawn(&whole);
    let count = if any_departs {
        settings.simulated_runs.max(RUNS_OF_ALL)
    } else {
        settings.simulated_runs
    };
    let runs = work.runs(count, &linear, columns.as_ref(), settings.seed)?;
    if any_departs {
        rms = runs.iter().map(|r| r.simulated_rms_nm).collect();
        rms.sort_unstable_by(f64::total_cmp);
    }
    let residual = Quantiles {
        median_nm: quantile(&rms, 0.5),
        below_95_percent_nm: quantile(&rms, 0.95),
        interval_95_percent_nm: [quantile(&rms, 0.025), quantile(&rms, 0.975)],
    };
    // With the same random numbers for all: what differs is the error that is left out.
    let below = |model: &Model| {
        let mut rms = model.draw(settings.draws.min(DRAWS_WITHOUT_ONE), settings.seed);
        rms.sort_unstable_by(f64::total_cmp);
        quantile(&rms, 0.95)
    };
    let without: Vec<f64> = (0..process.errors.len()).map(|i| below(&model(Some(i)))).collect();
    let least = without.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1));
    let first = least.filter(|(_, rms)| **rms < below(&whole)).map(|(index, rms)| First {
        index,
        kind: lines[index].kind.clone(),
        without_it_95_percent_nm: *rms,
    });
    let [low, high] = residual.interval_95_percent_nm;
    let difference = |p: &Pair| (p.simulated_rms_nm / p.first_order_rms_nm - 1.0).abs();
    let level = |k: usize| k as f64 / (LEVELS - 1) as f64;
    Ok(Tolerance {
        process: process.name.clone(),
        nominal_rms_nm: work.rms(&work.nominal),
        expected_rms_nm,
        residual,
        simulated: any_departs,
        errors: lines,
        first,
        largest_difference: runs
            .iter()
            .filter(|p| p.first_order_rms_nm > 0.0)
            .map(difference)
            .fold(0.0, f64::max),
        within_interval: runs.iter().filter(|p| (low..=high).contains(&p.simulated_rms_nm)).count(),
        runs,
        levels: (0..LEVELS).map(|k| (level(k), quantile(&rms, level(k)))).collect(),
        deviation_nm: work.deviation_map(&linear, &responses),
    })
}

fn check(settings: &Settings) -> Result<(), Invalid> {
    let draws = [("draws", settings.draws, 100, MOST_DRAWS)];
    let runs = [("simulated_runs", settings.simulated_runs, 0, MOST_SIMULATED_RUNS)];
    for (name, value, least, most) in draws.into_iter().chain(runs) {
        if !(least..=most).contains(&value) {
            let remedy = format!("give {least} to {most}");
            return Err(Invalid::whole(name, format!("is {value}"), remedy));
        }
    }
    budget::affordable("draws", settings.draws as f64, size_of::<f64>(), "give fewer")?;
    Ok(())
}

impl Work<'_> {
    fn rms(&self, judged: &Array2<f64>) -> f64 {
        self.inner.dot(judged, judged).sqrt()
    }

    /// Half the diagonal of the map, mm.
    fn reach_mm(&self) -> f64 {
        let size = [self.inner.grid.x, self.inner.grid.y].map(|a| a.end_mm() - a.start_mm());
        0.5 * size[0].hypot(size[1])
    }

    /// How far the tool moves, in mm (a TIF's change: times its width), per size of an effect.
    fn displacement_per_size(&self, effect: Scalar, width: f64) -> f64 {
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
                let remedy =
                    "give the size in its unit: an error moves the tool by less than its width";
                return Err(Invalid::at("errors", i, problem, remedy));
            }
        }
        Ok(())
    }

    /// The residual of a run.
    fn residual(&self, run: &Deviation) -> Result<Array2<f64>, Invalid> {
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

    /// The fields of all errors that one number decides, at size one.
    fn linear(&self, width: f64) -> Result<Vec<Linear>, Invalid> {
        let of = |(error, e): (usize, &ProcessError)| -> Result<Vec<Linear>, Invalid> {
            let distribution = e.stated.distribution;
            let linear = |field, size| Linear { error, distribution, field, size };
            match e.effect {
                _ if e.size == 0.0 => Ok(Vec::new()),
                Effect::Scalar(effect) => {
                    // A servo of any order begins as a lag.
                    let effect = match effect {
                        Scalar::ServoFirstOrder | Scalar::ServoSecondOrder { .. } => {
                            Scalar::VelocityLag
                        }
                        other => other,
                    };
                    // What acts on the rate is linear: any step will do.
                    let per_size = self.displacement_per_size(effect, width);
                    let step = if per_size > 0.0 { STEP * width / per_size } else { STEP };
                    let side = |step: f64| {
                        let mut run = Deviation::default();
                        run.add(effect, step);
                        self.residual(&run)
                    };
                    let field = (side(-step)? - side(step)?) / (2.0 * step);
                    Ok(vec![linear(field, e.size)])
                }
                Effect::MapLowOrder { degree } => {
                    let terms = self.low_order(degree);
                    let size = e.size / (terms.len() as f64).sqrt();
                    // The residual has it on top.
                    Ok(terms.into_iter().map(|t| linear(-self.inner.judged(t), size)).collect())
                }
                Effect::Noise(_) | Effect::MapNoise => Ok(Vec::new()),
            }
        };
        let each: Vec<Result<Vec<Linear>, Invalid>> =
            self.process.errors.par_iter().enumerate().map(of).collect();
        Ok(each.into_iter().collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect())
    }

    /// Legendre polynomials up to a total degree, the constant left out, of RMS one over the rectangle.
    fn low_order(&self, degree: usize) -> Vec<Array2<f64>> {
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
    fn noises(&self) -> Vec<(usize, Noise, f64)> {
        let each = self.process.errors.iter().enumerate();
        each.filter_map(|(i, e)| match e.effect {
            Effect::Noise(noise) if e.size > 0.0 => Some((i, noise, e.size)),
            _ => None,
        })
        .collect()
    }

    /// For every error, how far the run with its size alone is from its first order, nm RMS.
    fn departures(
        &self,
        linear: &[Linear],
        columns: Option<&Columns<'_>>,
        seed: u64,
    ) -> Result<Vec<f64>, Invalid> {
        let of = |(i, e): (usize, &ProcessError)| -> Result<f64, Invalid> {
            let mut run = Deviation::default();
            match (e.effect, columns) {
                _ if e.size == 0.0 => Ok(0.0),
                (Effect::Scalar(effect), _) => {
                    let l = linear.iter().find(|l| l.error == i).expect("it has a field");
                    run.add(effect, l.size);
                    let added = &self.nominal - &self.residual(&run)?;
                    let first = &l.field * l.size;
                    let difference = &added - &first;
                    Ok(self.rms(&difference))
                }
                (Effect::Noise(noise), Some(columns)) => {
                    let mut rng = stream(seed, DEPARTURE_STREAM + i as u64);
                    sample(noise, e.size, &self.motion, &mut rng, &mut run);
                    let added = &self.nominal - &self.residual(&run)?;
                    let mut added = self.inner.to_cells(&added);
                    let mut first = columns.change(&run);
                    self.inner.project_on_cells(&mut first);
                    added.iter_mut().zip(&first).for_each(|(a, f)| *a -= f);
                    Ok(self.inner.dot_on_cells(&added, &added).sqrt())
                }
                // What the map has wrong is in the residual as it is.
                _ => Ok(0.0),
            }
        };
        self.process.errors.par_iter().enumerate().map(of).collect()
    }

    /// The table, to first order.
    fn lines(
        &self,
        linear: &[Linear],
        responses: &[(usize, f64, Response)],
        reach: &Reach,
        departures: &[f64],
    ) -> Vec<Line> {
        let line = |(i, e): (usize, &ProcessError)| {
            let (mut square, mut reached) = (0.0, 0.0);
            for l in linear.iter().filter(|l| l.error == i) {
                let variance = match l.distribution {
                    Distribution::Normal | Distribution::Fixed => l.size * l.size,
                    Distribution::Uniform => l.size * l.size / 3.0,
                };
                square += variance * self.inner.dot(&l.field, &l.field);
                reached += variance * reach.mean_square(&self.inner, &l.field);
            }
            for (_, size, response) in responses.iter().filter(|(of, ..)| *of == i) {
                square += size * size * response.mean_square;
                reached += size * size * response.reached;
            }
            if e.effect == Effect::MapNoise {
                let free = self.inner.cells.free.len() as f64;
                let m = self.inner.count;
                square = e.size * e.size * (1.0 - free / m).max(0.0);
                reached =
                    (e.size * e.size * (reach.count() as f64 - free).max(0.0) / m).min(square);
            }
            let stated = &e.stated;
            Line {
                kind: stated.kind.name(),
                size: stated.size,
                unit: stated.unit.clone(),
                distribution: stated.distribution,
                note: stated.note.clone(),
                adds_rms_nm: square.sqrt(),
                reached_rms_nm: reached.sqrt(),
                unreached_rms_nm: (square - reached).max(0.0).sqrt(),
                departs_by_rms_nm: departures[i],
                simulated: false,
            }
        };
        self.process.errors.iter().enumerate().map(line).collect()
    }

    /// The line of an error from simulated runs.
    fn simulate_line(
        &self,
        index: usize,
        line: &mut Line,
        reach: &Reach,
        seed: u64,
    ) -> Result<(), Invalid> {
        let error = &self.process.errors[index];
        let squares = (0..RUNS_OF_ONE_ERROR as u64)
            .into_par_iter()
            .map(|k| {
                let mut rng = stream(seed, LINE_STREAM + ((index as u64) << 16) + k);
                let mut run = Deviation::default();
                match error.effect {
                    Effect::Scalar(effect) => {
                        run.add(effect, error.size * draw(error.stated.distribution, &mut rng));
                    }
                    Effect::Noise(noise) => {
                        sample(noise, error.size, &self.motion, &mut rng, &mut run)
                    }
                    Effect::MapLowOrder { .. } | Effect::MapNoise => {}
                }
                let added = &self.nominal - &self.residual(&run)?;
                let square = self.inner.dot(&added, &added);
                Ok((square, reach.mean_square(&self.inner, &added).min(square)))
            })
            .collect::<Result<Vec<_>, Invalid>>()?;
        let mean = |of: fn(&(f64, f64)) -> f64| {
            (squares.iter().map(of).sum::<f64>() / squares.len() as f64).sqrt()
        };
        line.adds_rms_nm = mean(|s| s.0);
        line.reached_rms_nm = mean(|s| s.1);
        line.unreached_rms_nm = mean(|s| s.0 - s.1);
        line.simulated = true;
        Ok(())
    }

    /// trace(S_perp^2) of the noise along the run, from products of independent draws of it:
    /// E <n, n'>^2 = trace(S^2).
    fn pool(&self, columns: &Columns<'_>, basis: &[Vec<f64>], seed: u64) -> f64 {
        let noises = self.noises();
        let fields: Vec<Vec<f64>> = (0..POOL as u64)
            .into_par_iter()
            .map(|k| {
                let mut rng = stream(seed, POOL_STREAM + k);
                let mut run = Deviation::default();
                for (_, noise, size) in &noises {
                    sample(*noise, *size, &self.motion, &mut rng, &mut run);
                }
                let mut field = columns.change(&run);
                self.inner.project_on_cells(&mut field);
                for q in basis {
                    let c = self.inner.dot_on_cells(q, &field);
                    field.iter_mut().zip(q).for_each(|(v, q)| *v -= c * q);
                }
                field
            })
            .collect();
        let squares: Vec<f64> = (0..POOL)
            .into_par_iter()
            .map(|i| {
                let product = |j: usize| self.inner.dot_on_cells(&fields[i], &fields[j]);
                (0..i).map(|j| product(j).powi(2)).sum()
            })
            .collect();
        squares.iter().sum::<f64>() / (POOL * (POOL - 1) / 2) as f64
    }

    /// Runs with all errors.
    fn runs(
        &self,
        count: usize,
        linear: &[Linear],
        columns: Option<&Columns<'_>>,
        seed: u64,
    ) -> Result<Vec<Pair>, Invalid> {
        let of = |k: u64| -> Result<Pair, Invalid> {
            let mut rng = stream(seed, RUN_STREAM + k);
            let mut run = Deviation::default();
            let mut first = self.nominal.clone();
            let mut map = Array2::zeros(self.inner.grid.shape());
            for (i, e) in self.process.errors.iter().enumerate().filter(|(_, e)| e.size != 0.0) {
                let mine = linear.iter().filter(|l| l.error == i);
                match e.effect {
                    Effect::Scalar(effect) => {
                        for l in mine {
                            let eta = l.size * draw(l.distribution, &mut rng);
                            run.add(effect, eta);
                            first.scaled_add(-eta, &l.field);
                        }
                    }
                    Effect::MapLowOrder { degree } => {
                        for (l, term) in mine.zip(self.low_order(degree)) {
                            let eta = l.size * draw(l.distribution, &mut rng);
                            map.scaled_add(eta, &term);
                            first.scaled_add(-eta, &l.field);
                        }
                    }
                    Effect::Noise(noise) => sample(noise, e.size, &self.motion, &mut rng, &mut run),
                    Effect::MapNoise => {
                        let mut white = Array2::zeros(self.inner.grid.shape());
                        for v in &mut white {
                            let xi: f64 = StandardNormal.sample(&mut rng);
                            *v = e.size * xi;
                        }
                        map += &white;
                        first += &self.inner.judged(white);
                    }
                }
            }
            let mut square = self.inner.dot(&first, &first);
            if let Some(columns) = columns {
                // |first - n|^2
                let mut noise = columns.change(&run);
                self.inner.project_on_cells(&mut noise);
                let first = self.inner.to_cells(&first);
                square += self.inner.dot_on_cells(&noise, &noise)
                    - 2.0 * self.inner.dot_on_cells(&first, &noise);
            }
            run.map_nm = Some(map);
            let simulated = self.residual(&run)?;
            Ok(Pair {
                simulated_rms_nm: self.rms(&simulated),
                first_order_rms_nm: square.max(0.0).sqrt(),
            })
        };
        (0..count as u64).into_par_iter().map(of).collect()
    }

    /// Standard deviation of every pixel over the runs, free terms removed from the fields of single numbers.
    fn deviation_map(
        &self,
        linear: &[Linear],
        responses: &[(usize, f64, Response)],
    ) -> Array2<f64> {
        let mut variance = vec![0.0; self.inner.cells.weight.len()];
        for (_, size, response) in responses {
            let each = variance.iter_mut().zip(&response.variance);
            each.for_each(|(v, more)| *v += size * size * more);
        }
        let mut map = self.inner.from_cells(&variance);
        for l in linear {
            let scale = match l.distribution {
                Distribution::Normal => l.size,
                Distribution::Uniform => l.size / 3.0_f64.sqrt(),
                Distribution::Fixed => continue,
            };
            map.zip_mut_with(&l.field, |v, f| *v += (scale * f).powi(2));
        }
        for e in self.process.errors.iter().filter(|e| e.effect == Effect::MapNoise) {
            map.mapv_inplace(|v| v + e.size * e.size);
        }
        self.inner.with_nan(map.mapv(f64::sqrt))
    }
}

/// Where the streams of random numbers of each use begin, below those of the draws.
const DEPARTURE_STREAM: u64 = 0;
const LINE_STREAM: u64 = 1 << 30;
const POOL_STREAM: u64 = 1 << 20;
const RUN_STREAM: u64 = 1 << 24;
