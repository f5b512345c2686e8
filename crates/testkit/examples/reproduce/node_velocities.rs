//! Node velocities that the authors of the PVT paper stored with a run of theirs, against the least squares
//! of the paper. They are in the file `instruments/pvt_model_scheduler.h5` of the folder
//! `PLANISH_REFERENCE`, from the authors' repository.
//!
//! Six unknowns per segment i: the coefficients k of `p(u) = sum k_j (u/h)^j` in the local time u, and the
//! velocity and acceleration `v_i`, `a_i` of its end. The rows are those of the paper (Eqs 9 to 14 and 16, the latter
//! soft), and, to see what is left of them in absolute time,
//!
//! ```text
//! sqrt(pull) C_j = 0,   p(t) = sum C_j t^j   in metres and seconds                             (1)
//! ```
//!
//! The normal matrix of the least squares in the C_j has elements from 1 to t^6, 3e17 after 800 s. Double precision has 16
//! digits, so that the small ones are lost in the rounding of the large ones, and a solver has to add something like (1).

use clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettingsBuilder, DefaultSolver, IPSolver,
        SupportedConeT::{NonnegativeConeT, ZeroConeT},
    },
};
use hdf5_reader::Hdf5File;
use planish_numerics::linear::tridiagonal::{self, TridiagonalRow as Row};
use planish_schedule::baselines::pvt_as_published;
use planish_testkit::{ion_beam, skipped::reference};
use planish_types::{DwellTime, ToolPath};

use crate::claim::{Claim, significant};

/// Weight of (1), in metres and seconds. Larger: the coefficients C_j are pulled towards zero more.
/// Smaller: (1) has less effect. Chosen: the decade that comes nearest to the stored velocities.
const PULL: f64 = 1e-10;

/// The run of the authors, per axis [x, y].
struct Stored {
    time_s: Vec<f64>,
    point_mm: [Vec<f64>; 2],
    velocity_mm_per_s: [Vec<f64>; 2],
}

impl Stored {
    fn read() -> Option<Self> {
        let file = reference()?.join("instruments/pvt_model_scheduler.h5");
        let file = Hdf5File::open(file).expect("the file is in the folder of the reference data");
        let read = |name: &str| -> Vec<f64> {
            let set = file.dataset(name).expect("a dataset");
            set.read_array::<f64>().expect("numbers").iter().copied().collect()
        };
        let mm = |name: &str| read(name).iter().map(|v| 1e3 * v).collect();
        Some(Self {
            time_s: read("t"),
            point_mm: [mm("px"), mm("py")],
            velocity_mm_per_s: [mm("vx"), mm("vy")],
        })
    }

    fn durations_s(&self) -> Vec<f64> {
        self.time_s.windows(2).map(|t| t[1] - t[0]).collect()
    }

    fn displacements_mm(&self, axis: usize) -> Vec<f64> {
        self.point_mm[axis].windows(2).map(|p| p[1] - p[0]).collect()
    }

    /// Nodes whose velocity is against the displacement of the segment before or after them.
    fn against(&self, axis: usize, is_before: bool) -> usize {
        let (dp, v) = (self.displacements_mm(axis), &self.velocity_mm_per_s[axis]);
        let ends = dp.iter().enumerate().map(|(i, dp)| (*dp, v[i + usize::from(is_before)]));
        // A resting axis counts as one that goes forward, as Eq. 18 has it.
        ends.filter(|(dp, v)| if *dp >= 0.0 { *v < 0.0 } else { *v > 0.0 }).count()
    }

    /// Smallest value of the objective of the paper with these velocities at the nodes, mm^2: with the best
    /// accelerations at the nodes, shared by the cubics, and the best cubics.
    fn objective_mm2(&self, axis: usize, v: &[f64]) -> f64 {
        let (h, dp) = (self.durations_s(), self.displacements_mm(axis));
        // Rows in A_i, A_{i+1} alone, after the start and the end of the cubic are eliminated:
        //   (v1 - v0 - h (A0 + A1)/2) / sqrt 2 = 0
        //   (P1 - P0 - h (v0 + v1)/2 + h^2 (A1 - A0)/12) / sqrt(2 + h^2/2) = 0
        let rows = |i: usize| {
            let (h, sum) = (h[i], v[i] + v[i + 1]);
            let shift = (2.0 + 0.5 * h * h).sqrt();
            let area = h * h / 12.0 / shift;
            let turn = -0.5 * h / 2.0_f64.sqrt();
            [
                ([turn, turn], (v[i + 1] - v[i]) / 2.0_f64.sqrt()),
                ([-area, area], (dp[i] - 0.5 * h * sum) / shift),
            ]
        };
        let n = v.len();
        let mut normal = vec![Row { elements: [0.0; 3], right: 0.0 }; n];
        for i in 0..n - 1 {
            for ([a, b], right) in rows(i) {
                normal[i].elements[1] += a * a;
                normal[i].elements[2] += a * b;
                normal[i].right -= a * right;
                normal[i + 1].elements[0] += a * b;
                normal[i + 1].elements[1] += b * b;
                normal[i + 1].right -= b * right;
            }
        }
        let a = tridiagonal::solve(n, |i| normal[i]);
        (0..n - 1)
            .flat_map(|i| rows(i).map(|r| (i, r)))
            .fold(0.0, |sum, (i, ([p, q], right))| sum + (p * a[i] + q * a[i + 1] + right).powi(2))
    }

    /// Velocities of nodes 1 to N by Eqs 9 to 16 and (1), with the bounds of Eq. 18 by the segment before
    /// the node.
    fn pulled(&self, axis: usize) -> Vec<f64> {
        let (h, dp) = (self.durations_s(), self.displacements_mm(axis));
        let (n, limits) = (h.len(), ion_beam());
        let mut rows = Rows::default();
        for (i, (h, dp)) in h.iter().zip(&dp).enumerate() {
            let k = 6 * i;
            let before = |value: f64| (i > 0).then(|| (k - 2, value));
            // p(0) = P0, p(h) = P1; then p'(0) = v0, p'(h) = v1, p''(0) = a0, p''(h) = a1
            rows.add(&[(k, 1.0)], 0.0);
            rows.add(&[(k, 1.0), (k + 1, 1.0), (k + 2, 1.0), (k + 3, 1.0)], *dp);
            let mut start = vec![(k + 1, 1.0 / h)];
            start.extend(before(-1.0));
            rows.add(&start, 0.0);
            rows.add(&[(k + 1, 1.0 / h), (k + 2, 2.0 / h), (k + 3, 3.0 / h), (k + 4, -1.0)], 0.0);
            let mut start = vec![(k + 2, 2.0 / (h * h))];
            start.extend(before(-1.0).map(|(j, value)| (j + 1, value)));
            rows.add(&start, 0.0);
            rows.add(&[(k + 2, 2.0 / (h * h)), (k + 3, 6.0 / (h * h)), (k + 5, -1.0)], 0.0);
            // (1): C_j = sum over d >= j of k_d / h^d binomial(d, j) (-t0)^(d - j)
            let (t0, root) = (self.time_s[i], PULL.sqrt());
            for j in 0..4 {
                let of = |d: usize| {
                    let power = BINOMIAL[d][j] * (-t0).powi((d - j) as i32);
                    (k + d, root * power / h.powi(d as i32))
                };
                let start = if j == 0 { self.point_mm[axis][i] } else { 0.0 };
                rows.add(&(j..4).map(of).collect::<Vec<_>>(), -root * start);
            }
        }
        // Eq. 16, soft: rest at the end of the first segment and of the last one.
        for k in [4, 5, 6 * n - 2, 6 * n - 1] {
            rows.add(&[(k, 1.0)], 0.0);
        }
        let (v, a) =
            (limits.max_velocity_mm_per_s()[axis], limits.max_acceleration_mm_per_s2()[axis]);
        let bounds = dp.iter().enumerate().flat_map(|(i, dp)| {
            let (low, high) = if *dp >= 0.0 { (0.0, v) } else { (-v, 0.0) };
            [(6 * i + 4, low, high), (6 * i + 5, -a, a)]
        });
        let x = rows.least_squares(6 * n, &bounds.collect::<Vec<_>>());
        (0..n).map(|i| x[6 * i + 4]).collect()
    }
}

const BINOMIAL: [[f64; 4]; 4] =
    [[1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [1.0, 2.0, 1.0, 0.0], [1.0, 3.0, 3.0, 1.0]];

/// Rows of a least squares.
#[derive(Default)]
struct Rows {
    row: Vec<usize>,
    column: Vec<usize>,
    value: Vec<f64>,
    right: Vec<f64>,
}

impl Rows {
    fn add(&mut self, elements: &[(usize, f64)], right: f64) {
        for (column, value) in elements {
            self.row.push(self.right.len());
            self.column.push(*column);
            self.value.push(*value);
        }
        self.right.push(right);
    }

    /// min |J x - right|^2 within bounds (unknown, low, high): J x - r = right, min |r|^2.
    fn least_squares(mut self, n: usize, bounds: &[(usize, f64, f64)]) -> Vec<f64> {
        let m = self.right.len();
        for i in 0..m {
            self.row.push(i);
            self.column.push(n + i);
            self.value.push(-1.0);
        }
        for (k, low, high) in bounds {
            self.add(&[(*k, 1.0)], *high);
            self.add(&[(*k, -1.0)], -low);
        }
        let total = self.right.len();
        let a = CscMatrix::new_from_triplets(total, n + m, self.row, self.column, self.value);
        let residual: Vec<usize> = (n..n + m).collect();
        let p =
            CscMatrix::new_from_triplets(n + m, n + m, residual.clone(), residual, vec![1.0; m]);
        let settings = DefaultSettingsBuilder::default().verbose(false).build().expect("settings");
        let cones = [ZeroConeT(m), NonnegativeConeT(total - m)];
        let solver = DefaultSolver::new(&p, &vec![0.0; n + m], &a, &self.right, &cones, settings);
        let mut solver = solver.expect("a problem");
        solver.solve();
        solver.solution.x[..n].to_vec()
    }
}

/// Pearson's coefficient.
pub fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
        a.iter().zip(b).map(|(x, y)| f(x - ma, y - mb)).sum()
    };
    sum(&|x, y| x * y) / (sum(&|x, _| x * x) * sum(&|_, y| y * y)).sqrt()
}

/// The rows; none without the reference data.
pub fn rows() -> Vec<Claim> {
    let Some(stored) = Stored::read() else { return Vec::new() };
    let points = (0..stored.time_s.len()).map(|i| [0, 1].map(|a| stored.point_mm[a][i]));
    let n = stored.time_s.len() - 1;
    let path = ToolPath::through(points.collect(), vec![true; n], vec![0; n]).expect("a path");
    let dwell = DwellTime::new(stored.durations_s()).expect("dwell times");
    let ours = pvt_as_published::schedule(&path, &dwell, &ion_beam(), &Default::default());
    let ours = ours.expect("a motion").trajectory;
    // The velocities at the nodes; at rest at the end.
    let ours = [0, 1].map(|axis| {
        let v = ours.coefficient_mm().iter().map(|c| c[axis][1]).chain([0.0]);
        v.collect::<Vec<f64>>()
    });
    let both = |f: &dyn Fn(usize) -> f64, digits: usize| {
        let values = [0, 1].map(f);
        (values, values.map(|v| significant(v, digits)).join(" and "))
    };
    let theirs = &stored.velocity_mm_per_s;
    let (alike, alike_text) = both(&|a| correlation(&ours[a], &theirs[a]), 3);
    let (_, objective) =
        both(&|a| stored.objective_mm2(a, &theirs[a]) / stored.objective_mm2(a, &ours[a]), 2);
    let ratio =
        [0, 1].map(|a| stored.objective_mm2(a, &theirs[a]) / stored.objective_mm2(a, &ours[a]));
    let (pulled, pulled_text) = both(&|a| correlation(&stored.pulled(a), &theirs[a][1..]), 3);
    let against = |is_before: bool| [0, 1].map(|a| stored.against(a, is_before));
    let ([x, y], before) = (against(false), against(true));
    vec![
        Claim::statement(
            "node velocities of a run that the authors stored (1023 segments): correlation with the least squares of the paper on the same points and times, x and y",
            "1",
            alike_text,
            alike.iter().all(|r| *r > 0.99),
        )
        .differs("what they stored is not the minimum of the paper's problem: the three next rows"),
        Claim::statement(
            "v_i has the sign of the segment after node i (Eq. 18; nodes against it)",
            "it has",
            format!("{x} and {y} nodes are against it"),
            x + y == 0,
        )
        .differs(format!("the stored ones have that of the segment before it, all but {}", before[0] + before[1])),
        Claim::statement(
            "they minimise Eq. 14 (its least value with these velocities over the least of all, x and y)",
            "1",
            objective,
            ratio.iter().all(|r| *r < 1.01),
        )
        .differs("solved in absolute time, whose normal matrix has elements from 1 to 3e17 (next row)"),
        Claim::check(
            "the same with the sign by the segment before, and a pull of 1e-10 on the coefficients in absolute time (m, s): correlation with the stored ones",
            pulled_text,
            pulled.iter().all(|r| *r > 0.99),
        )
        .remark("the pull is fitted, by decades. Rounding in absolute time would act like it: hardly on segments of seconds, strongly on short ones. Their solver itself was not run"),
    ]
}
