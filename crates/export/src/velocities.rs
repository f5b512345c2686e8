//! Velocities of the nodes of one axis, with positions and times fixed.
//!
//! The velocities v* of the plan at the nodes are taken if they keep the limits. Otherwise the velocities are the
//! solution of a quadratic program over all nodes, whose objective is the integral of the squared difference of the
//! accelerations:
//!
//! ```text
//! min 1/2 (v - v*)' H (v - v*)      H_kk = 4/T_{k-1} + 4/T_k,  H_{k,k+1} = 2/T_k
//! |6 m - 4 v_k - 2 v_{k+1}| <= A T,   |2 v_k + 4 v_{k+1} - 6 m| <= A T,   |v| <= V
//! |6 (v_k + v_{k+1}) - 12 m| <= J T^2                                 m = dp / T
//! ```
//!
//! Here v_k is the velocity at node k, T_k the duration and dp_k the distance of segment k, which follows node k. V, A
//! and J are the limits on velocity, acceleration and jerk. They are reduced by what rounding the velocities to their
//! unit q can add: 3 q / T of the acceleration, 6 q / T^2 of the jerk, q of the velocity.

use planish_numerics::{
    polynomial::{derivative, range},
    qp::chain,
};
use planish_types::MachineAxis;

/// Fraction of a limit that is left for the tolerance of the interior point method. Larger: slower programs. Smaller: a
/// limit may be exceeded by that tolerance. Chosen.
const MARGIN: f64 = 1e-6;

/// Weight of an excess of a limit in the objective, relative to the largest diagonal term of a node. Larger: a program
/// that is badly conditioned. Smaller: a larger excess than necessary. Chosen.
const PRICE: f64 = 1e4;

/// Largest number of quadratic programs that are solved until the velocity keeps its limit within every segment too.
/// Larger: more time. Smaller: velocities that exceed it, so that the plan is slowed down there. Chosen.
const MOST_PROGRAMS: usize = 12;

/// Data of one axis whose positions and times at the nodes are fixed; n is the number of segments.
pub(crate) struct Axis<'a> {
    /// Signed distance of every segment, mm or deg, length n; velocities and limits have the same unit.
    pub distance: &'a [f64],
    /// Duration of every segment, s, length n.
    pub time_s: &'a [f64],
    /// Velocity of the plan at every node, length n+1; zero at both ends.
    pub planned: &'a [f64],
    pub limits: &'a MachineAxis,
    /// Unit of the velocity in the program, of which velocities are multiples.
    pub unit: f64,
    /// True for the nodes at which the axis rests, length n+1.
    pub rests: &'a [bool],
}

impl Axis<'_> {
    /// Returns the rounded velocities (n+1), and for every segment (n) the factor by which its time has to grow to keep
    /// the limits; 1 if it keeps them.
    pub fn velocities(&self) -> (Vec<f64>, Vec<f64>) {
        let (planned, excess) = self.rounded(self.planned);
        if excess.iter().all(|e| *e <= 1.0) {
            return (planned, excess);
        }
        // The least excess says where more time is needed.
        match self.program(false).or_else(|| self.program(true)) {
            Some(v) => self.rounded(&v),
            None => (planned, excess),
        }
    }

    /// Rounds velocities (n+1) to their unit, with 0 where the axis rests. Returns them and the factor by which the
    /// time of every segment (n) has to grow.
    fn rounded(&self, v: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let rounded: Vec<f64> = (v.iter().zip(self.rests))
            .map(|(v, rests)| if *rests { 0.0 } else { (v / self.unit).round() * self.unit })
            .collect();
        let segments = rounded.windows(2).enumerate();
        let excess = segments.map(|(k, v)| self.excess(k, [v[0], v[1]])).collect();
        (rounded, excess)
    }

    /// Returns the factor by which the time of segment `k` has to grow to keep the limits on velocity, acceleration and
    /// jerk; 1 if they are kept. `v` holds the velocities at its start and at its end.
    fn excess(&self, k: usize, v: [f64; 2]) -> f64 {
        let t = self.time_s[k];
        let c = hermite(self.distance[k], v, t);
        let first = derivative(&c);
        let second = derivative(&first);
        let limits = self.limits;
        let speed = range(&first, t).peak().0 / limits.max_velocity;
        let acceleration = range(&second, t).peak().0 / limits.max_acceleration;
        let jerk = limits.max_jerk.map_or(0.0, |j| second[1].abs() / j);
        speed.max(acceleration.sqrt()).max(jerk.cbrt()).max(1.0)
    }

    /// Solves the quadratic program. If `elastic` is true, limits may be exceeded at a price. Returns the velocities
    /// (n+1); `None` if there is no solution, or if velocities within segments still exceed their limit after
    /// [`MOST_PROGRAMS`] programs.
    fn program(&self, elastic: bool) -> Option<Vec<f64>> {
        let n = self.time_s.len();
        let t = self.time_s;
        let most_v = (1.0 - MARGIN) * self.limits.max_velocity - self.unit;
        // Where the largest velocity of a segment is bounded, beside its ends, in units of its time.
        let mut within: Vec<Vec<f64>> = vec![Vec::new(); n];
        for _ in 0..MOST_PROGRAMS {
            let program = self.objective(elastic);
            let mut v =
                chain::solve(program, |k, rows| self.rows(k, &within[k], most_v, rows)).ok()?;
            for k in (0..=n).filter(|k| self.rests[*k]) {
                v[k] = 0.0;
            }
            let mut complete = true;
            for (k, within) in within.iter_mut().enumerate() {
                let first = derivative(&hermite(self.distance[k], [v[k], v[k + 1]], t[k]));
                let (peak, at_s) = range(&first, t[k]).peak();
                let u = at_s / t[k];
                let is_new = within.iter().all(|known| (known - u).abs() > 1e-6);
                if peak > most_v && u > 0.0 && u < 1.0 && is_new && !elastic {
                    within.push(u);
                    complete = false;
                }
            }
            if complete {
                return Some(v);
            }
        }
        None
    }

    /// Returns the program without its constraints: the matrix H, the vector H v*, the free nodes, and the price of an
    /// excess. An excess has a price only if `elastic` is true.
    fn objective(&self, elastic: bool) -> chain::ChainProgram {
        let n = self.time_s.len();
        let t = self.time_s;
        let mut diagonal = Vec::with_capacity(n + 1);
        for k in 0..=n {
            let before = if k > 0 { 4.0 / t[k - 1] } else { 0.0 };
            diagonal.push(before + if k < n { 4.0 / t[k] } else { 0.0 });
        }
        let beside: Vec<f64> = t.iter().map(|t| 2.0 / t).collect();
        let moving = self.planned.iter().zip(self.rests);
        let planned: Vec<f64> = moving.map(|(v, rests)| if *rests { 0.0 } else { *v }).collect();
        let mut linear = Vec::with_capacity(n + 1);
        for k in 0..=n {
            let mut c = diagonal[k] * planned[k];
            if k > 0 {
                c += beside[k - 1] * planned[k - 1];
            }
            if k < n {
                c += beside[k] * planned[k + 1];
            }
            linear.push(c);
        }
        let mut price = Vec::new();
        if elastic {
            let stiffest = diagonal.iter().copied().fold(0.0, f64::max);
            let fastest = self.limits.max_velocity;
            let mean_s = t.iter().sum::<f64>() / n as f64;
            let unit = PRICE * stiffest * fastest * fastest / mean_s;
            price = t.iter().map(|t| unit * t).collect();
        }
        let free = self.rests.iter().map(|rests| !rests).collect();
        chain::ChainProgram { diagonal, beside, linear, free, price }
    }

    /// Adds the constraints of segment `k`; `within` has the positions in it, as fractions of its time, at which the
    /// velocity is limited too. `most_v` is the velocity limit less its margin and the rounding, and `rows` gets the
    /// constraints.
    fn rows(&self, k: usize, within: &[f64], most_v: f64, rows: &mut chain::ChainRows) {
        let t = self.time_s[k];
        let m = self.distance[k] / self.time_s[k];
        let q = self.unit;
        let limits = self.limits;
        let mut both = |row: [f64; 2], constant: f64, slack: f64, bound: f64| {
            rows.add(row, slack, bound - constant);
            rows.add(row.map(|v| -v), slack, bound + constant);
        };
        let a = (1.0 - MARGIN) * limits.max_acceleration * t - 3.0 * q;
        let slack = limits.max_acceleration * t;
        both([-4.0, -2.0], 6.0 * m, slack, a);
        both([2.0, 4.0], -6.0 * m, slack, a);
        both([1.0, 0.0], 0.0, most_v, most_v);
        both([0.0, 1.0], 0.0, most_v, most_v);
        if let Some(jerk) = limits.max_jerk {
            let j = (1.0 - MARGIN) * jerk * t * t - 6.0 * q;
            both([6.0, 6.0], -12.0 * m, jerk * t * t, j);
        }
        for u in within {
            // v(u) = (1-u)^2 v0 + 2u(1-u) (3 m - v0 - v1) + u^2 v1
            let w = 1.0 - u;
            let mixed = 2.0 * u * (1.0 - u);
            both([w * w - mixed, u * u - mixed], 3.0 * mixed * m, most_v, most_v);
        }
    }
}

/// Returns the ascending coefficients of the cubic from position 0 over `distance` in `time_s`, with the velocities `v`
/// at its ends.
pub(crate) fn hermite(distance: f64, v: [f64; 2], time_s: f64) -> [f64; 4] {
    let mean = distance / time_s;
    [
        0.0,
        v[0],
        (3.0 * mean - 2.0 * v[0] - v[1]) / time_s,
        (v[0] + v[1] - 2.0 * mean) / (time_s * time_s),
    ]
}
