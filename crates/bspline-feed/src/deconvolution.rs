//! The control values of the feed of all passes for a map. A line is a straight pass of the path with its spline.
//!
//! ```text
//! min over d, and a free piston c:
//!   1/2 sum_x (z(x) + c - sum_m (G_m d_m)(x))^2
//!   + 1/2 alpha K sum (d - 1/F)^2 + 1/2 beta K sum_m |second differences of d_m|^2            (1)
//! subject to the limits of every pass (crate::limited)
//! ```
//!
//! over the valid pixels; K is the largest diagonal element of the `G_m'G_m`. A TIF wider than the pitch
//! couples the lines: what one removes its neighbours need not. The convex-concave procedure solves (1) for all
//! lines at once and proves how good it is (`joint`). Knot removal, a procedure for one line, goes by
//! block Gauss-Seidel sweeps: with the residual e of all lines,
//!
//! ```text
//! P_m = G_m'G_m + alpha K I + beta K (second differences)'(second differences)
//! q_m = G_m'(e + G_m d_m) + alpha K / F
//! d_m <- the solution for line m (crate::limited),   e <- e - G_m (change of d_m)           (2)
//! ```
//!
//! Its steps may raise (1), because each starts from all knots again. A sweep that raises (1) is given up, and ends the
//! sweeps. Nothing is proven of its result. Lines that do not see each other's
//! pixels are solved at the same time; the result does not depend on the number of threads.
//!
//! Source: the B-spline deconvolution of feed profiles, Eqs 8-10 for one line; the coupling, the
//! regularisation and the free piston are ours.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | d_m | `d` | (passes, n_m) | s/mm |
//! | e | `residual_nm` | (ny, nx) | nm |
//! | c | `piston_nm` | - | nm |

use ndarray::Array2;
use planish_numerics::{bspline::Knots, parallel};
use planish_types::{Surface, Tif, progress};
use serde::Serialize;

use crate::{
    FeedError,
    columns::{self, Column},
    limited::{self, FeedLimits, Quadratic},
    passes::Pass,
};

/// Largest number of pixels of all columns of the removal basis (3.2 GB of memory); more are refused. Larger: more
/// memory. Smaller: fine knots on large maps are refused.
const MAX_ELEMENTS: usize = 400_000_000;

/// Methods to keep the acceleration limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Refinement {
    /// Convex-concave procedure.
    ConvexConcave,
    /// Removal of knots next to the highest acceleration.
    KnotRemoval,
}

/// Settings of the deconvolution.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DeconvolutionSettings {
    /// Method to keep the acceleration limit.
    pub refinement: Refinement,
    /// True if the piston is free: the solver may add any uniform removal to the desired one.
    pub free_piston: bool,
    /// Weight of the squared distance of the control values from the smallest density (alpha of the module), >= 0.
    pub tikhonov: f64,
    /// Weight of the squared second differences of the control values (beta of the module), >= 0.
    pub curvature_weight: f64,
    /// Largest proven gap of the objective, as a fraction of it, with which the solver ends. For knot removal, smallest
    /// relative decrease of the objective in a sweep.
    pub tolerance: f64,
    /// Largest number of steps of the interior point method, or of sweeps of knot removal.
    pub max_sweeps: usize,
}

/// One pass of the path with its spline and its removal basis.
#[derive(Debug)]
pub struct PassBasis {
    /// Knots of the spline over the arc length, from 0 to the length of the pass, mm.
    pub knots: Knots,
    /// Limits of the feed along the pass.
    pub limits: FeedLimits,
    columns: Vec<Column>,
    /// Products G'G of the columns, shape (n, n) for n control values.
    gram: Array2<f64>,
}

/// All lines (passes with their splines), and groups of lines that reach no common pixel and can be solved at the same
/// time.
#[derive(Debug)]
pub struct Problem {
    /// Lines (passes with their splines), in the order of the path.
    pub lines: Vec<PassBasis>,
    /// Largest diagonal element of the products G'G of all lines (K of the module).
    strongest: f64,
    groups: Vec<Vec<usize>>,
}

/// Control values and piston at which the solver starts.
#[derive(Clone, Debug)]
pub struct Start {
    /// Control values of the spline of every pass, positive, s/mm.
    pub d: Vec<Vec<f64>>,
    /// Uniform removal in addition to the desired one (c of the module), nm.
    pub piston_nm: f64,
}

/// Control values, and the residual that they leave.
#[derive(Clone, Debug)]
pub struct State {
    /// Control values of the spline of every pass, s/mm.
    pub d: Vec<Vec<f64>>,
    /// Uniform removal in addition to the desired one (c of the module), nm.
    pub piston_nm: f64,
    /// Residual r of the module, shape (ny, nx), nm; 0 where the map is invalid.
    pub residual_nm: Array2<f64>,
    /// Objective (1) of the module after every sweep or step, nm^2; the first value is that of the start.
    pub objective: Vec<f64>,
    /// Number of sweeps, or of steps of the interior point method.
    pub steps: usize,
    /// True if the gap is within the tolerance, or the last sweep lowered the objective by less than the tolerance.
    pub converged: bool,
    /// Proven gap: no feed within the tangents of the acceleration limit lowers the objective by a larger fraction
    /// (`joint`). `None` for sweeps, which prove nothing, and if the gap did not reach the tolerance.
    pub gap: Option<f64>,
    /// Objective, nm^2, after a last sweep that raised it and was undone; `None` if there was none.
    pub given_up_nm2: Option<f64>,
    /// Knots of the spline of every pass that knot removal left; all knots for the other method.
    pub knots_left: Vec<Knots>,
    /// Number of passes in the last sweep on which knot removal removed all interior knots without success, so that a
    /// step of the convex-concave procedure took over.
    pub fallbacks: usize,
    pub(crate) rows_mm: Vec<Vec<f64>>,
}

impl Problem {
    /// Computes the basis of every pass on its knots.
    ///
    /// # Errors
    /// Refuses a basis that takes too much memory, and passes along which the tool reaches no valid pixel.
    pub fn new(
        passes: &[Pass],
        knots: Vec<Knots>,
        tif: &Tif,
        surface: &Surface,
    ) -> Result<Self, FeedError> {
        let elements =
            passes.iter().zip(&knots).map(|(p, k)| columns::elements(p, k, tif, surface));
        let elements = elements.sum();
        if elements > MAX_ELEMENTS {
            let control_values = knots.iter().map(Knots::len).sum();
            return Err(FeedError::TooLarge { control_values, elements, limit: MAX_ELEMENTS });
        }
        let bases = parallel::map(passes.len(), &|m| {
            let columns = columns::columns(&passes[m], &knots[m], tif, surface);
            let gram = gram(&columns);
            (columns, gram)
        });
        let lines: Vec<PassBasis> = (passes.iter().zip(knots).zip(bases))
            .map(|((pass, knots), (columns, gram))| PassBasis {
                knots,
                limits: limits(pass),
                columns,
                gram,
            })
            .collect();
        let strongest = lines.iter().flat_map(|l| l.gram.diag().to_vec()).fold(0.0, f64::max);
        if strongest <= 0.0 {
            return Err(FeedError::OutOfReach);
        }
        let groups = groups(&lines);
        Ok(Self { lines, strongest, groups })
    }

    /// Runs sweeps of knot removal from a start within the limits. They end when the objective falls by no more than
    /// the tolerance, when a sweep raises it, or after `max_sweeps`. `other_nm` (ny, nx) is the removal by other parts
    /// of the motion. The objective of the result is not larger than that of the start.
    ///
    /// # Errors
    /// Returns the failure of the quadratic program of a pass.
    pub fn sweeps(
        &self,
        surface: &Surface,
        other_nm: &Array2<f64>,
        start: Start,
        settings: &DeconvolutionSettings,
    ) -> Result<State, FeedError> {
        let mut first_fall = None;
        let mut state = self.start(surface, other_nm, start);
        let mut before = self.objective(&state, settings);
        state.objective.push(before);
        while state.objective.len() <= settings.max_sweeps {
            let last = state.clone();
            self.sweep(&mut state, settings)?;
            if settings.free_piston {
                free_piston(surface, &mut state);
            }
            let now = self.objective(&state, settings);
            if now > before {
                // Knot removal promises nothing.
                state = State { given_up_nm2: Some(now), ..last };
                break;
            }
            let fall = (before - now) / before;
            let first = *first_fall.get_or_insert(fall);
            progress::done(progress::of_convergence(first, fall, settings.tolerance));
            state.objective.push(now);
            state.steps += 1;
            state.converged = fall <= settings.tolerance;
            if state.converged {
                break;
            }
            before = now;
        }
        Ok(state)
    }

    /// Returns the weights alpha K and beta K of the penalties in (1) of the module; alpha counts as at least 1e-12.
    pub(crate) fn weights(&self, settings: &DeconvolutionSettings) -> [f64; 2] {
        // A trace of the identity makes the quadratic program definite where the tool reaches nothing.
        [settings.tikhonov.max(1e-12), settings.curvature_weight].map(|w| w * self.strongest)
    }

    /// Returns the columns of the removal basis of pass `m`, one per control value.
    pub(crate) fn columns(&self, m: usize) -> &[Column] {
        &self.lines[m].columns
    }

    /// Returns the columns of the removal bases of all passes, in the order of the path.
    pub(crate) fn all_columns(&self) -> impl Iterator<Item = &Column> {
        self.lines.iter().flat_map(|line| &line.columns)
    }

    /// Returns the first and last row, and the first and last column, of the pixels that the tool reaches along pass
    /// `m`; `None` if it reaches none.
    pub(crate) fn pixels(&self, m: usize) -> Option<[usize; 4]> {
        bounding_box(&self.lines[m])
    }

    /// Makes a state without control values and residual, but with all knots, to be filled by a solver.
    pub(crate) fn untouched(&self) -> State {
        State {
            d: Vec::new(),
            piston_nm: 0.0,
            residual_nm: Array2::zeros((0, 0)),
            objective: Vec::new(),
            steps: 0,
            converged: false,
            gap: None,
            given_up_nm2: None,
            knots_left: self.lines.iter().map(|l| l.knots.clone()).collect(),
            fallbacks: 0,
            rows_mm: vec![Vec::new(); self.lines.len()],
        }
    }

    /// Makes the state at the start values, with their residual. `other_nm` (ny, nx) is the removal by other parts of
    /// the motion.
    fn start(&self, surface: &Surface, other_nm: &Array2<f64>, start: Start) -> State {
        let Start { d, piston_nm } = start;
        // e = z + c - other - G d on the valid pixels
        let mut residual_nm = surface.height_nm() - other_nm + piston_nm;
        residual_nm.mapv_inplace(|r| if r.is_nan() { 0.0 } else { r });
        for (line, d) in self.lines.iter().zip(&d) {
            for (column, d) in line.columns.iter().zip(d) {
                column.add_to(&mut residual_nm, -d);
            }
        }
        State { d, piston_nm, residual_nm, ..self.untouched() }
    }

    /// Replaces the control values of every pass by the solution of step (2) of the module, group by group.
    fn sweep(&self, state: &mut State, settings: &DeconvolutionSettings) -> Result<(), FeedError> {
        state.fallbacks = 0;
        for group in &self.groups {
            let before = &*state;
            let solved = parallel::map(group.len(), &|k| self.line(group[k], before, settings));
            for (&m, solved) in group.iter().zip(solved) {
                let solved = solved.map_err(|status| FeedError::Solver { pass: m, status })?;
                for (i, column) in self.lines[m].columns.iter().enumerate() {
                    let change = solved.d[i] - state.d[m][i];
                    if change != 0.0 {
                        column.add_to(&mut state.residual_nm, -change);
                    }
                }
                state.d[m] = solved.d;
                state.rows_mm[m] = solved.rows_mm;
                state.knots_left[m] = solved.knots_left;
                state.fallbacks += usize::from(solved.fallback);
            }
        }
        Ok(())
    }

    /// Solves step (2) of the module for pass `m` by knot removal, or, if that fails, does one convex-concave step.
    fn line(
        &self,
        m: usize,
        state: &State,
        settings: &DeconvolutionSettings,
    ) -> Result<Solved, String> {
        let line = &self.lines[m];
        let objective = self.line_objective(m, state, settings);
        let mut solved = Solved {
            d: Vec::new(),
            rows_mm: state.rows_mm[m].clone(),
            knots_left: state.knots_left[m].clone(),
            fallback: false,
        };
        if let Some((d, knots)) = limited::knot_removal(&objective, &line.knots, line.limits)? {
            solved.d = d;
            solved.knots_left = knots;
            return Ok(solved);
        }
        solved.fallback = true;
        solved.d = limited::convex_concave_step(
            &objective,
            &line.knots,
            line.limits,
            &state.d[m],
            &mut solved.rows_mm,
        )?;
        Ok(solved)
    }

    /// Returns the matrix P_m and the vector q_m of step (2) of the module for pass `m`, with the residual of all
    /// passes in `state`.
    fn line_objective(
        &self,
        m: usize,
        state: &State,
        settings: &DeconvolutionSettings,
    ) -> Quadratic {
        let line = &self.lines[m];
        let current = &state.d[m];
        let n = current.len();
        let [alpha, beta] = self.weights(settings);
        let mut p = line.gram.clone();
        let mut q: Vec<f64> = line.columns.iter().map(|c| c.dot(&state.residual_nm)).collect();
        for i in 0..n {
            q[i] += (0..n).map(|j| line.gram[[i, j]] * current[j]).sum::<f64>();
            q[i] += alpha * line.limits.min_density_s_per_mm;
            p[[i, i]] += alpha;
        }
        for i in 1..n - 1 {
            let row = [(i - 1, 1.0), (i, -2.0), (i + 1, 1.0)];
            for (a, va) in row {
                for (b, vb) in row {
                    p[[a, b]] += beta * va * vb;
                }
            }
        }
        Quadratic { p, q }
    }

    /// Returns the value of the objective (1) of the module, nm^2.
    fn objective(&self, state: &State, settings: &DeconvolutionSettings) -> f64 {
        let [alpha, beta] = self.weights(settings);
        let mut sum = state.residual_nm.iter().map(|r| r * r).sum::<f64>();
        for (line, d) in self.lines.iter().zip(&state.d) {
            let least = line.limits.min_density_s_per_mm;
            sum += alpha * d.iter().map(|d| (d - least).powi(2)).sum::<f64>();
            let second = d.windows(3).map(|w| (w[0] - 2.0 * w[1] + w[2]).powi(2));
            sum += beta * second.sum::<f64>();
        }
        0.5 * sum
    }
}

/// Solution of step (2) of the module for one line: its control values, the arc lengths of its acceleration
/// constraints, and the knots that are left.
struct Solved {
    d: Vec<f64>,
    rows_mm: Vec<f64>,
    knots_left: Knots,
    fallback: bool,
}

/// Returns the limits of the dwell-time density and of the acceleration along a pass.
pub(crate) fn limits(pass: &Pass) -> FeedLimits {
    FeedLimits {
        min_density_s_per_mm: 1.0 / pass.max_feed_mm_per_s,
        max_acceleration_mm_per_s2: pass.max_acceleration_mm_per_s2,
    }
}

/// Sets the piston to the value with which the residual has the mean 0.
fn free_piston(surface: &Surface, state: &mut State) {
    state.piston_nm -= subtract_mean(surface, &mut state.residual_nm);
}

/// Subtracts the mean of a residual over the valid pixels from these pixels, and returns the mean, nm. The residual has
/// to be 0 at the invalid pixels.
pub(crate) fn subtract_mean(surface: &Surface, residual_nm: &mut Array2<f64>) -> f64 {
    let count = surface.height_nm().iter().filter(|z| !z.is_nan()).count();
    let mean = residual_nm.sum() / count as f64;
    ndarray::Zip::from(residual_nm).and(surface.height_nm()).for_each(|r, z| {
        if !z.is_nan() {
            *r -= mean;
        }
    });
    mean
}

/// Returns the scalar products of the n columns with each other, G'G, shape (n, n).
fn gram(columns: &[Column]) -> Array2<f64> {
    let n = columns.len();
    let mut gram = Array2::zeros((n, n));
    for i in 0..n {
        for j in 0..=i {
            let v = columns[i].dot_column(&columns[j]);
            gram[[i, j]] = v;
            gram[[j, i]] = v;
        }
    }
    gram
}

/// Divides the lines (passes with their splines) into groups whose lines reach no common pixel, as lists of indices.
/// Each line is in the first group that it fits.
fn groups(lines: &[PassBasis]) -> Vec<Vec<usize>> {
    let boxes: Vec<Option<[usize; 4]>> = lines.iter().map(bounding_box).collect();
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for m in 0..lines.len() {
        match groups.iter_mut().find(|g| g.iter().all(|k| !share_pixels(boxes[m], boxes[*k]))) {
            Some(group) => group.push(m),
            None => groups.push(vec![m]),
        }
    }
    groups
}

/// Returns true if two boxes, each its first and last row and column, have a pixel in common.
pub(crate) fn share_pixels(a: Option<[usize; 4]>, b: Option<[usize; 4]>) -> bool {
    match (a, b) {
        (Some([t, b, l, r]), Some([u, c, m, s])) => u <= b && t <= c && m <= r && l <= s,
        _ => false,
    }
}

/// Returns the first and last row, and the first and last column, of the pixels that the tool reaches along a line (a
/// pass with its spline); `None` if it reaches none.
fn bounding_box(line: &PassBasis) -> Option<[usize; 4]> {
    let boxes = line.columns.iter().filter_map(Column::pixels);
    boxes.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1]), a[2].min(b[2]), a[3].max(b[3])])
}
