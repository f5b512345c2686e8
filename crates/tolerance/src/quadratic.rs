//! Expected mean square of the residual as a quadratic in the dwell times: the part of a process that they decide.
//!
//! With b_j what a second at dwell point j of a motion removes, t_j the times, independent errors eta_k of variance
//! s_k^2, and z, M and P of the [crate],
//!
//! ```text
//! E |e|^2 = |P (z - M - m)|^2 + t'Q t + constant
//! t'Q t   = sum_k s_k^2 |P sum_j t_j c_kj|^2                         one number eta_k
//!         + s^2 sum_kl C_kl t_j(k) t_j(l) <P b_k, P b_l>             noise of the rate, of pieces k and l
//!         + s^2 sum_j t_j^2 (|P db_j/dx|^2 + |P db_j/dy|^2)          noise of the positions
//! ```
//!
//! c_kj is the derivative of b_j by eta_k. The TIF acts in seven ways (`Kernels`): as it is, displaced along x and y,
//! wider, elliptical, rotated, and elliptical along the diagonals. The effect of an error of one number at a place
//! and a time is a combination of them. C is the covariance of the Ornstein-Uhlenbeck process between pieces of the
//! motion. Each term is a sum of squares, so Q is positive semidefinite. Q is never made: a product with it takes a
//! pass over the columns.
//!
//! A tool that varies over the part, sum_k a_k(p) phi_k, acts in the same ways at every place: each way of every
//! kernel has the weight of the kernel there, and a displacement changes the weights as well.
//!
//! Q is that of one motion. The motion gives the places and times of the tool, and the times at which the rate has
//! drifted. m is the change of the removal by the `fixed` errors of the process, simulated: they are known, and a
//! plan can compensate for them.
//!
//! Errors that add the same whatever the dwell times are no part of Q: the jitter and the tick, which are times of
//! their own; the map's; and a lag that scatters, because the time that the tool takes for a millimetre times its
//! velocity is one. Play that scatters is left out, too: it acts at the places where an axis turns back, which no
//! derivative by a time moves.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | t | `time_s` | s |
//! | c_kj | `Column::value` | nm/s per size |
//! | m | `Quadratic::bias_nm` | nm |
//! | s_k^2 | `Sources::scalars` | size^2 |

use std::ops::Range;

use ndarray::Array2;
use planish_numerics::{keys, parallel, polynomial::evaluate, quadrature::gauss_legendre};
use planish_simulate::{SimulationPlan as Plan, SimulationSettings as Simulation};
use planish_types::{Grid, Invalid, Surface, Tif, Trajectory, budget};

use crate::{
    deviation::{Deviation, check_tool, has_one_ellipse},
    error_budget::{Distribution, Effect, ErrorBudget, Noise, Scalar},
    field::{Change, Field, Tool, cells_of_tif, field, reached},
    inner::Inner,
    lines::STEP,
    motion::{Motion, MotionPiece as Piece},
    sample::Mean,
    settings::Free,
    tool::smooth,
};

/// Number of changes of the TIF from which the effects of errors are combined, the unchanged TIF included; the
/// constants below are their indices.
const KERNELS: usize = 7;
const AS_IT_IS: usize = 0;
const ALONG_X: usize = 1;
const ALONG_Y: usize = 2;
const WIDER: usize = 3;
const ELLIPTICAL: usize = 4;
const ROTATED: usize = 5;
const DIAGONAL: usize = 6;

/// Number of Gauss points of a piece, over which the tool moves by at most half the width of the TIF. For a Gaussian
/// the integral errs by `(1/2)^4 / 4320` of its fourth derivative times the width^4. Larger: more time. Smaller: a
/// larger error.
const POINTS: usize = 2;

/// The errors of a process whose effect depends on the dwell times, prepared for one mirror.
pub struct Sources {
    inner: Inner,
    /// The TIF that errors change.
    moved: Tif,
    /// The same TIF on the cells, without its factor of the time.
    tool: Tool,
    width_mm: f64,
    kernels: Kernels,
    /// Errors that a single number describes, with their variances.
    scalars: Vec<(Scalar, f64)>,
    /// Variance of the position error of every dwell point along each axis, mm^2.
    place_mm2: f64,
    /// Correlation time, s, and variance of every noise of the rate.
    rates: Vec<(f64, f64)>,
    /// Errors of a fixed size; `None` if there are none.
    fixed: Option<Deviation>,
    /// Kinds of the errors that are in Q or in m of the module, in the order of the process.
    pub included: Vec<String>,
    /// Kinds of the errors that are neither in Q nor in m of the module, in the order of the process.
    pub left_out: Vec<String>,
}

impl Sources {
    /// Prepares the errors of `process` on the map `desired` with `tif`; errors of size zero are left out.
    ///
    /// # Errors
    /// Refuses errors that the tool cannot have, and changes of the TIF that cannot be made.
    pub fn new(
        desired: &Surface,
        tif: &Tif,
        process: &ErrorBudget,
        free: Free,
    ) -> Result<Self, Invalid> {
        check_tool(process, tif)?;
        let width = tif.width_mm();
        let moved = smooth(tif, width)?;
        let inner = Inner::new(desired, free, width);
        let tool = Tool::new(&moved, &inner);
        let mut sources = Self {
            kernels: Kernels::new(&tool.tif)?,
            inner,
            moved,
            tool,
            width_mm: width,
            scalars: Vec::new(),
            place_mm2: 0.0,
            rates: Vec::new(),
            fixed: None,
            included: Vec::new(),
            left_out: Vec::new(),
        };
        for e in process.errors.iter().filter(|e| e.size != 0.0) {
            let square = e.size * e.size;
            let variance = match e.stated.distribution {
                Distribution::Normal => square,
                Distribution::Uniform => square / 3.0,
                Distribution::Fixed => 0.0,
            };
            let included = match e.effect {
                Effect::Scalar(effect) if e.stated.distribution == Distribution::Fixed => {
                    sources.fixed.get_or_insert_default().add(effect, e.size);
                    true
                }
                Effect::Scalar(effect) if combination(effect).is_some() => {
                    match sources.scalars.iter_mut().find(|(other, _)| *other == effect) {
                        Some((_, sum)) => *sum += variance,
                        None => sources.scalars.push((effect, variance)),
                    }
                    true
                }
                Effect::Noise(Noise::Position) => {
                    sources.place_mm2 += variance;
                    true
                }
                Effect::Noise(Noise::Rate { correlation_s }) => {
                    sources.rates.push((correlation_s, variance));
                    true
                }
                _ => false,
            };
            let list = if included { &mut sources.included } else { &mut sources.left_out };
            list.push(e.stated.kind.name());
        }
        Ok(sources)
    }

    /// Returns true if no error of the process has an effect that depends on the dwell times.
    pub fn is_empty(&self) -> bool {
        self.included.is_empty()
    }

    /// Computes m and Q of the module for a motion that serves dwell points with the indices 0 .. `points`.
    ///
    /// # Errors
    /// Refuses a motion or a map that takes too much memory, and errors that cannot be simulated.
    pub fn quadratic(
        &self,
        trajectory: &Trajectory,
        points: usize,
    ) -> Result<Quadratic<'_>, Invalid> {
        let motion = Motion::new(trajectory, 0.5 * self.width_mm)?.with_rate_of(&self.moved);
        let bias_nm = self.fixed.as_ref().map(|fixed| self.change(fixed, &motion)).transpose()?;
        let pieces = if self.rates.is_empty() { 0 } else { motion.pieces.len() };
        let fields = (points * self.combined().len() + pieces) as f64;
        let remedy = "give fewer errors, or crop and bin the map and the TIF";
        let cells = cells_of_tif(&self.inner, &self.tool.tif);
        budget::affordable("errors", fields * cells as f64, 8, remedy)?;

        let mut of_point: Vec<Vec<usize>> = vec![Vec::new(); points];
        for (i, piece) in motion.pieces.iter().enumerate().filter(|(_, p)| p.tool_on) {
            if let Some(own) = motion.point_of_stay[piece.stay].and_then(|j| of_point.get_mut(j)) {
                own.push(i);
            }
        }
        let served_s: Vec<f64> = of_point
            .iter()
            .map(|own| own.iter().map(|i| motion.pieces[*i].duration_s).sum())
            .collect();
        // g of the pieces, for the errors that act on the rate
        let rates = self.combined().into_iter().map(|(effect, _)| -> Vec<f64> {
            let mut run = Deviation::default();
            run.add(effect, 1.0);
            motion.pieces.iter().map(|p| run.rate_at(p, motion.total_s)).collect()
        });
        let rates: Vec<Vec<f64>> = rates.collect();
        let mut columns: Vec<Column> =
            parallel::map(points, &|j| self.column(&motion, &of_point[j], &rates, served_s[j]));
        let mut place = vec![0.0; points];
        if self.place_mm2 > 0.0 {
            let each = columns.iter_mut().zip(&mut place);
            parallel::consume(each, &|_, (column, place)| *place = self.displaced(column));
        }
        let mut of_pieces: Vec<(usize, usize)> = Vec::new();
        if !self.rates.is_empty() {
            for (j, own) in of_point.iter().enumerate() {
                of_pieces.extend(own.iter().map(|i| (j, *i)));
            }
        }
        of_pieces.sort_unstable_by_key(|(_, i)| *i);
        let pieces = parallel::map(of_pieces.len(), &|k| {
            let (j, i) = of_pieces[k];
            self.carried(j, &motion.pieces[i], 1.0 / served_s[j])
        });
        Ok(Quadratic { sources: self, bias_nm, columns, place, pieces, total_s: motion.total_s })
    }

    /// Prepares a piece that serves dwell point `j`, for the noise of the rate; `part` is 1 over the time of the point,
    /// 1/s.
    fn carried(&self, j: usize, piece: &Piece, part: f64) -> Carried {
        let field = field(piece, &self.inner, &self.tool, Change::AsItIs);
        let free = self.inner.cells.free.iter().map(|q| self.dot(q, &field)).collect();
        let Piece { start_s, duration_s, .. } = *piece;
        Carried { point: j, part, start_s, duration_s, field, free }
    }

    /// Returns the errors of `scalars`. If positions are noisy, displacements along x and y are included, with the
    /// variance 0 if no error has them.
    fn combined(&self) -> Vec<(Scalar, f64)> {
        let mut all = self.scalars.clone();
        for axis in [Scalar::OffsetX, Scalar::OffsetY] {
            if self.place_mm2 > 0.0 && !all.iter().any(|(effect, _)| *effect == axis) {
                all.push((axis, 0.0));
            }
        }
        all
    }

    /// Returns the difference of the removals of a run with these errors and of one without, shape (ny, nx), nm.
    fn change(&self, run: &Deviation, motion: &Motion) -> Result<Array2<f64>, Invalid> {
        Ok(self.removal_nm(run, motion)? - self.removal_nm(&Deviation::default(), motion)?)
    }

    /// Simulates the removal of a run with these errors, shape (ny, nx), nm.
    fn removal_nm(&self, run: &Deviation, motion: &Motion) -> Result<Array2<f64>, Invalid> {
        let grid = &self.inner.grid;
        let other = run.tif(&self.tool.tif)?;
        let tif = other.as_ref().unwrap_or(&self.tool.tif);
        let plan = Plan::new(tif, grid, Simulation::Gridded)?;
        Ok(plan.removal_nm(&run.trajectory(motion, grid)?)?.0)
    }

    /// Computes c_kj of the module for a dwell point, which the pieces `own` of the motion serve for `served_s`
    /// seconds. `rates` are the relative rates of the errors in the pieces.
    fn column(&self, motion: &Motion, own: &[usize], rates: &[Vec<f64>], served_s: f64) -> Column {
        let grid = &self.inner.grid;
        let middle = [&grid.x, &grid.y].map(|a| 0.5 * (a.start_mm() + a.end_mm()));
        let errors = self.combined();
        let mut points = Vec::with_capacity(POINTS * own.len());
        for i in own {
            let piece: &Piece = &motion.pieces[*i];
            for (node, weight) in gauss_legendre::<POINTS>() {
                let u = node * piece.duration_s;
                let place = [0, 1].map(|a| evaluate(&piece.coefficient_mm[a], u));
                let from_middle = [place[0] - middle[0], place[1] - middle[1]];
                let part = weight * piece.duration_s * piece.rate_factor / served_s;
                let acts: Vec<[f64; KERNELS]> = errors
                    .iter()
                    .zip(rates)
                    .map(|((effect, _), rate)| {
                        let weights = combination(*effect).expect("others are left out");
                        weights(from_middle, rate[*i]).map(|c| c * part)
                    })
                    .collect();
                points.push((self.kernels.placed(&self.tool, place), acts));
            }
        }
        let cells = &self.inner.cells;
        let (rows, columns) =
            reached(points.iter().map(|(p, _)| p.place_mm), &self.inner, &self.tool.tif);
        if points.is_empty() || rows.is_empty() || columns.is_empty() || errors.is_empty() {
            return Column::default();
        }
        let size = rows.len() * columns.len();
        let mut value = vec![0.0; errors.len() * size];
        for (r, row) in rows.clone().enumerate() {
            for (c, column) in columns.clone().enumerate() {
                let cell = row * cells.shape.1 + column;
                if cells.weight[cell] == 0.0 {
                    continue;
                }
                let [x, y] = cells.centre_mm[cell];
                let factor = self.tool.factor(cell);
                for (placed, acts) in &points {
                    let Some(kernel) = self.kernels.values(placed, x, y) else { continue };
                    for (k, act) in acts.iter().enumerate() {
                        let sum: f64 = act.iter().zip(&kernel).map(|(a, v)| a * v).sum();
                        value[k * size + r * columns.len() + c] += factor * sum;
                    }
                }
            }
        }
        Column { rows, columns, value }
    }

    /// Returns |P db/dx|^2 + |P db/dy|^2 of the module for a dwell point, and removes the values that only this needs
    /// from the column.
    fn displaced(&self, column: &mut Column) -> f64 {
        let size = column.rows.len() * column.columns.len();
        let all = self.combined();
        let [x, y] = [Scalar::OffsetX, Scalar::OffsetY].map(|axis| {
            let k = all.iter().position(|(effect, _)| *effect == axis).expect("both are there");
            let value = column.value.get(k * size..(k + 1) * size).unwrap_or(&[]).to_vec();
            let rows = column.rows.clone();
            self.square(&Field { rows, columns: column.columns.clone(), value })
        });
        let sum = x + y;
        column.value.truncate(self.scalars.len() * size);
        sum
    }

    /// Returns the inner product <q, f> of a field `q` on all cells and a field `f` on a box.
    fn dot(&self, q: &[f64], f: &Field) -> f64 {
        let cells = &self.inner.cells;
        let lines = f.lines(cells.shape.1).map(|(first, line)| -> f64 {
            let here = first..first + line.len();
            let each = line.iter().zip(&cells.weight[here.clone()]).zip(&q[here]);
            each.map(|((v, w), q)| v * w * q).sum()
        });
        lines.sum::<f64>() / self.inner.count
    }

    /// Returns the mean square of a field without its free terms, |P f|^2.
    fn square(&self, f: &Field) -> f64 {
        let cells = &self.inner.cells;
        let lines = f.lines(cells.shape.1).map(|(first, line)| -> f64 {
            line.iter().zip(&cells.weight[first..]).map(|(v, w)| v * v * w).sum()
        });
        let all = lines.sum::<f64>() / self.inner.count;
        let free: f64 = cells.free.iter().map(|q| self.dot(q, f).powi(2)).sum();
        (all - free).max(0.0)
    }
}

/// Function that returns the weights of the changes of the TIF for an error of size one. Its arguments are the position
/// `[x, y]`, mm, from the middle of the map, and a relative rate g.
type Combination = fn([f64; 2], f64) -> [f64; KERNELS];

/// Returns the combination of the changes of the TIF by which an error acts; `None` for a lag and for play, whose
/// effect depends on more than position and time.
fn combination(effect: Scalar) -> Option<Combination> {
    fn one(kernel: usize, value: f64) -> [f64; KERNELS] {
        let mut all = [0.0; KERNELS];
        all[kernel] = value;
        all
    }
    fn displaced(x: f64, y: f64) -> [f64; KERNELS] {
        let mut all = one(ALONG_X, x);
        all[ALONG_Y] = y;
        all
    }
    Some(match effect {
        Scalar::RateScale | Scalar::RateDrift | Scalar::RateWarmUp { .. } => {
            |_, g| one(AS_IT_IS, g)
        }
        Scalar::OffsetX => |_, _| displaced(1.0, 0.0),
        Scalar::OffsetY => |_, _| displaced(0.0, 1.0),
        Scalar::Rotation => |[x, y], _| displaced(-y, x),
        Scalar::Magnification => |[x, y], _| displaced(x, y),
        Scalar::Shear => |[_, y], _| displaced(y, 0.0),
        Scalar::TifWidth => |_, _| one(WIDER, 1.0),
        Scalar::TifEllipticity => |_, _| one(ELLIPTICAL, 1.0),
        Scalar::TifRotation => |_, _| one(ROTATED, 1.0),
        Scalar::TifDiagonalEllipticity => |_, _| one(DIAGONAL, 1.0),
        Scalar::VelocityLag
        | Scalar::ServoFirstOrder
        | Scalar::ServoSecondOrder { .. }
        | Scalar::Smoothing
        | Scalar::CornerSpeed { .. }
        | Scalar::Backlash => return None,
    })
}

/// All changes of a kernel at each of its samples, with a ring of zeros around them.
type Samples = Vec<[f64; KERNELS]>;

/// The TIF, or every kernel of a varying one, and its changes by errors, at its samples; Keys' convolution interpolates
/// between them.
struct Kernels {
    grid: Grid,
    samples: Vec<Samples>,
}

/// Position of the tool, with the weight of every kernel there and its derivatives along x and y, 1/mm.
struct Placed {
    place_mm: [f64; 2],
    weights: Vec<[f64; 3]>,
}

impl Kernels {
    /// Computes the changes of the TIF of a tool whose rate does not depend on the time.
    fn new(tif: &Tif) -> Result<Self, Invalid> {
        let width = changed(tif, Scalar::TifWidth)?;
        let mut shapes = vec![(WIDER, width), (ROTATED, changed(tif, Scalar::TifRotation)?)];
        if has_one_ellipse(tif) {
            shapes.push((ELLIPTICAL, changed(tif, Scalar::TifEllipticity)?));
            shapes.push((DIAGONAL, changed(tif, Scalar::TifDiagonalEllipticity)?));
        }
        let count = tif.variation().map_or(1, |v| v.components().len());
        let samples = (0..count).map(|k| samples_of(k, tif, &shapes)).collect();
        Ok(Self { grid: *tif.grid(), samples })
    }

    /// Prepares the tool at the position `place_mm`.
    fn placed(&self, tool: &Tool, place_mm: [f64; 2]) -> Placed {
        let half = [self.grid.x.step_mm(), self.grid.y.step_mm()].map(|step| 0.5 * step);
        let slopes = [0, 1].map(|axis| -> Vec<f64> {
            let [before, after] = [-half[axis], half[axis]].map(|by_mm| {
                let mut place = place_mm;
                place[axis] += by_mm;
                tool.weights(place)
            });
            after.iter().zip(before).map(|(a, b)| (a - b) / (2.0 * half[axis])).collect()
        });
        let weights = tool.weights(place_mm).into_iter().enumerate();
        let weights = weights.map(|(k, a)| [a, slopes[0][k], slopes[1][k]]).collect();
        Placed { place_mm, weights }
    }

    /// Returns all changes of the rate at a point of the part; `None` beyond the samples.
    fn values(&self, placed: &Placed, x_mm: f64, y_mm: f64) -> Option<[f64; KERNELS]> {
        let Grid { x, y } = &self.grid;
        let [dx, dy] = [x_mm - placed.place_mm[0], y_mm - placed.place_mm[1]];
        let (column, wx) = node_and_weights((dx - x.start_mm()) / x.step_mm(), x.len())?;
        let (row, wy) = node_and_weights((dy - y.start_mm()) / y.step_mm(), y.len())?;
        let interpolated = |samples: &Samples| {
            let mut sum = [0.0; KERNELS];
            for (r, wy) in wy.iter().enumerate() {
                let first = (row + r) * (x.len() + 2) + column;
                for (sample, wx) in samples[first..first + 4].iter().zip(&wx) {
                    let w = wx * wy;
                    sum.iter_mut().zip(sample).for_each(|(s, v)| *s += w * v);
                }
            }
            sum
        };
        if placed.weights.is_empty() {
            return Some(interpolated(&self.samples[0]));
        }
        let mut sum = [0.0; KERNELS];
        for (samples, [a, along_x, along_y]) in self.samples.iter().zip(&placed.weights) {
            let kernel = interpolated(samples);
            sum.iter_mut().zip(&kernel).for_each(|(s, v)| *s += a * v);
            sum[ALONG_X] += along_x * kernel[AS_IT_IS];
            sum[ALONG_Y] += along_y * kernel[AS_IT_IS];
        }
        Some(sum)
    }
}

/// Returns the node and Keys' weights for a coordinate `s`, in steps from the first of n samples; `None` beyond them.
fn node_and_weights(s: f64, n: usize) -> Option<(usize, [f64; 4])> {
    let (i, f) = keys::split(s);
    if (0..n as isize - 1).contains(&i) { Some((i as usize, keys::weights(f))) } else { None }
}

/// Returns the TIF with the error `effect` of plus and of minus [`STEP`], as a fraction or in rad.
fn changed(tif: &Tif, effect: Scalar) -> Result<[Tif; 2], Invalid> {
    let [up, down] = [STEP, -STEP].map(|step| {
        let mut run = Deviation::default();
        run.add(effect, step);
        Ok(run.tif(tif)?.unwrap_or_else(|| tif.clone()))
    });
    Ok([up?, down?])
}

/// Returns the changes of kernel `k` of a tool at its samples; `shapes` are the tools with each error of shape by a
/// step up and down.
fn samples_of(k: usize, tif: &Tif, shapes: &[(usize, [Tif; 2])]) -> Samples {
    fn kernel(tif: &Tif, k: usize) -> &Tif {
        tif.variation().map_or(tif, |v| v.components()[k].kernel())
    }
    let own = kernel(tif, k);
    let grid = *tif.grid();
    let (ny, nx) = grid.shape();
    let half = [grid.x.step_mm(), grid.y.step_mm()].map(|step| 0.5 * step);
    let mut samples = vec![[0.0; KERNELS]; (ny + 2) * (nx + 2)];
    for r in 0..ny {
        for c in 0..nx {
            let x = grid.x.coordinate_mm(c);
            let y = grid.y.coordinate_mm(r);
            // The tool moves, the place stays: the derivative is by minus the offset.
            let along_x = own.rate_at(x - half[0], y) - own.rate_at(x + half[0], y);
            let along_y = own.rate_at(x, y - half[1]) - own.rate_at(x, y + half[1]);
            let sample = &mut samples[(r + 1) * (nx + 2) + c + 1];
            sample[AS_IT_IS] = own.rate_nm_per_s()[[r, c]];
            sample[ALONG_X] = along_x / (2.0 * half[0]);
            sample[ALONG_Y] = along_y / (2.0 * half[1]);
            for (index, changed) in shapes {
                let [up, down] = changed.each_ref().map(|t| kernel(t, k).rate_nm_per_s()[[r, c]]);
                sample[*index] = (up - down) / (2.0 * STEP);
            }
        }
    }
    samples
}

/// The numbers c_kj of the module for a dwell point j and every error k, on a box of the cells: error by error, row by
/// row.
#[derive(Default)]
struct Column {
    rows: Range<usize>,
    columns: Range<usize>,
    value: Vec<f64>,
}

impl Column {
    /// Returns the rows of the values of error `k`: for each the index of its first cell, and its values.
    fn lines(&self, k: usize, cells_per_row: usize) -> impl Iterator<Item = (usize, &[f64])> {
        let size = self.rows.len() * self.columns.len();
        let width = self.columns.len().max(1);
        let own = self.value.get(k * size..(k + 1) * size).unwrap_or(&[]);
        let first = self.rows.start * cells_per_row + self.columns.start;
        let lines = own.chunks_exact(width).enumerate();
        lines.map(move |(r, line)| (first + r * cells_per_row, line))
    }
}

/// A piece of the motion, prepared for the noise of the rate.
struct Carried {
    point: usize,
    /// 1 over the time of the dwell point that the piece serves, 1/s.
    part: f64,
    start_s: f64,
    duration_s: f64,
    /// Removal by the piece at the rate of the plan, nm.
    field: Field,
    /// Inner products of the field with the free terms.
    free: Vec<f64>,
}

/// Additional removal m by fixed errors, and quadratic form Q of the scattering errors, for one motion.
pub struct Quadratic<'a> {
    sources: &'a Sources,
    /// Additional removal by the fixed errors (m of the module), shape (ny, nx), nm; `None` if no error is fixed.
    pub bias_nm: Option<Array2<f64>>,
    columns: Vec<Column>,
    /// Mean square of the change by a displacement, |P db/dx|^2 + |P db/dy|^2, of every dwell point, (nm/s/mm)^2.
    place: Vec<f64>,
    pieces: Vec<Carried>,
    total_s: f64,
}

impl Quadratic<'_> {
    /// Returns Q t for the dwell times `time_s`, length n, nm^2/s: half the derivative of t'Q t by each of them.
    pub fn product(&self, time_s: &[f64]) -> Vec<f64> {
        let Sources { scalars, place_mm2, rates, .. } = self.sources;
        let mut product: Vec<f64> =
            self.place.iter().zip(time_s).map(|(d, t)| place_mm2 * d * t).collect();
        let scalars =
            parallel::map(scalars.len(), &|k| self.scalar_product(k, scalars[k].1, time_s));
        let rates = parallel::map(rates.len(), &|k| {
            let (tau, variance) = rates[k];
            let mut sum = vec![0.0; time_s.len()];
            for (piece, value) in self.pieces.iter().zip(self.correlated(tau, time_s)) {
                sum[piece.point] += variance * piece.part * value;
            }
            sum
        });
        for more in scalars.iter().chain(&rates) {
            product.iter_mut().zip(more).for_each(|(p, m)| *p += m);
        }
        product
    }

    /// Returns the part of Q t of error k with this variance: `s_k^2 <c_kj, f>` with f = P sum_j t_j c_kj.
    fn scalar_product(&self, k: usize, variance: f64, time_s: &[f64]) -> Vec<f64> {
        let inner = &self.sources.inner;
        let per_row = inner.cells.shape.1;
        let mut f = vec![0.0; inner.cells.weight.len()];
        for (column, t) in self.columns.iter().zip(time_s) {
            for (first, line) in column.lines(k, per_row) {
                let into = &mut f[first..first + line.len()];
                into.iter_mut().zip(line).for_each(|(f, c)| *f += t * c);
            }
        }
        inner.project_on_cells(&mut f);
        let each = f.iter_mut().zip(&inner.cells.weight);
        each.for_each(|(f, w)| *f *= variance * w / inner.count);
        let products = self.columns.iter().map(|column| {
            let lines = column.lines(k, per_row).map(|(first, line)| -> f64 {
                line.iter().zip(&f[first..]).map(|(c, f)| c * f).sum()
            });
            lines.sum()
        });
        products.collect()
    }

    /// Returns t'Q t for the dwell times `time_s`, nm^2: the mean square that the scattering errors add on average.
    pub fn variance_nm2(&self, time_s: &[f64]) -> f64 {
        self.product(time_s).iter().zip(time_s).map(|(q, t)| q * t).sum()
    }

    /// Returns sum_l C_kl x_l <P b_k, P b_l> for every piece k. C is the covariance for the correlation time `tau`, and
    /// x the dwell time of a piece's point over its time in the plan.
    fn correlated(&self, tau: f64, time_s: &[f64]) -> Vec<f64> {
        let part = |p: &Carried| p.part * time_s[p.point];
        let (earlier, later) = rayon::join(
            || self.carry(self.pieces.iter().map(|p| (p, p.start_s, part(p))), tau),
            || {
                let mirrored = self.pieces.iter().rev().map(|p| {
                    let begin_s = self.total_s - p.start_s - p.duration_s;
                    (p, begin_s, part(p))
                });
                self.carry(mirrored, tau)
            },
        );
        let both = earlier.iter().zip(later.iter().rev());
        let each = self.pieces.iter().zip(both).map(|(p, (e, l))| {
            let mean = Mean::over(p.duration_s / tau);
            mean.variance * part(p) * self.sources.square(&p.field) + e + l
        });
        each.collect()
    }

    /// Returns `a_k <P b_k, P s_k>` for every piece k, with `s_k = sum_l a_l x_l b_l exp(-gap / tau)` over the pieces
    /// before it. Each of `pieces` comes with the time at which it begins, and its x.
    fn carry<'p>(
        &self,
        pieces: impl Iterator<Item = (&'p Carried, f64, f64)>,
        tau: f64,
    ) -> Vec<f64> {
        let cells = &self.sources.inner.cells;
        let count = self.sources.inner.count;
        let mut carried = vec![0.0; cells.weight.len()];
        let mut until = vec![0.0; cells.weight.len()];
        let mut free = vec![0.0; cells.free.len()];
        let mut now = 0.0;
        pieces
            .map(|(piece, begin, x)| {
                let h = piece.duration_s;
                let Mean { weight: a, .. } = Mean::over(h / tau);
                let end = begin + h;
                let decay = (-h / tau).exp();
                let mut sum = 0.0;
                for (first, line) in piece.field.lines(cells.shape.1) {
                    for (i, b) in (first..).zip(line) {
                        let s = carried[i] * ((until[i] - begin) / tau).exp();
                        sum += cells.weight[i] * b * s;
                        carried[i] = s * decay + a * x * b;
                        until[i] = end;
                    }
                }
                sum /= count;
                let gap = ((now - begin) / tau).exp();
                for (s, q) in free.iter_mut().zip(&piece.free) {
                    *s *= gap;
                    sum -= q * *s;
                    *s = *s * decay + a * x * q;
                }
                now = end;
                a * sum
            })
            .collect()
    }
}
