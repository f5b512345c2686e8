//! The best residual (1) of `splines`, by a primal-dual interior-point method.
//!
//! ```text
//! min over a, Lambda:  1/2 a'G a + T Lambda,   V'a + Lambda - q_z = s >= 0,   Lambda >= 0,   u'a = 0        (1)
//! G a - V m + c u = 0,   sum m + m_0 = T,   m s = m_0 Lambda = mu                                          (2)
//! ```
//!
//! It is the dual problem of (2) of the module above. The multipliers m >= 0 are dwell times, m_0 is the time of the
//! tool beside the part, and c belongs to the mean of the residual. With a price of time in place of a time, Lambda is
//! that price and no unknown. Newton's step of (2) needs one factorisation of `G + V D V'`, `D = m / s`, bordered by
//! the rows of Lambda and c. Steps follow Mehrotra's predictor and corrector.
//!
//! Source: S. Mehrotra, SIAM J. Optim. 2 (1992) 575.

use ndarray::{Array1, Zip};
use planish_numerics::linear::skyline::{Factor, dot};

use super::{
    Budget,
    splines::{Constraints, Splines},
};

/// Largest number of steps. Larger: no change, because problems take 15 to 30. Smaller: bounds are not the best ones.
const MAX_STEPS: usize = 60;

/// Part of the way to the nearest bound that a step goes. Larger: fewer steps, and numbers near 0. Smaller: more steps.
const PART_OF_WAY: f64 = 0.995;

/// Result of the method.
pub struct Solution {
    /// Coefficients a of the splines.
    pub coefficients: Vec<f64>,
    /// Dwell times m at the places, s.
    pub dwell_s: Array1<f64>,
}

/// The matrices of a problem.
#[derive(Clone, Copy)]
pub struct InteriorProblem<'a> {
    /// Splines S.
    pub splines: &'a Splines,
    /// Places at which the adjoint is bounded.
    pub constraints: &'a Constraints,
    /// Square of the norm of the desired removal, nm^2.
    pub energy: f64,
    /// Rough time for all of the desired removal, s.
    pub scale_s: f64,
    /// Complementarity, relative to the square of the residual, at which the steps end.
    pub complementarity: f64,
}

/// A point of the method, and a step of it.
struct InteriorPoint {
    a: Vec<f64>,
    c: f64,
    price: f64,
    /// Slack s at the places.
    slack: Array1<f64>,
    /// Dwell times m at the places.
    dwell_s: Array1<f64>,
    /// Time m_0 beside the part, s.
    beside_s: f64,
}

/// Remainder of (2) at a point.
struct Left {
    stationary: Vec<f64>,
    mean: f64,
    time_s: f64,
    feasible: Array1<f64>,
}

/// Finds the best residual for a budget.
pub fn solve(problem: InteriorProblem<'_>, budget: Budget) -> Solution {
    let mut point = start(problem, budget);
    for _ in 0..MAX_STEPS {
        let left = left(problem, &point, budget);
        let complementarity = point.complementarity(budget);
        let InteriorProblem { splines, energy, .. } = problem;
        let stretched = splines.gram.product(&point.a);
        let residual =
            energy - 2.0 * dot(&point.a, &splines.along_desired) + dot(&point.a, &stretched);
        let total_s = point.dwell_s.sum() + point.beside_s;
        if complementarity <= problem.complementarity * residual
            && left.time_s.abs() <= 1e-6 * total_s
        {
            break;
        }
        let Some(newton) = Newton::new(problem, &point, budget) else { break };
        let predictor = newton.step(&left, point.products(0.0, None));
        let after = point.after(&predictor, point.longest(&predictor));
        let ratio = (after.complementarity(budget) / complementarity).clamp(0.0, 1.0);
        let centre = ratio.powi(3) * complementarity / (point.slack.len() as f64 + 1.0);
        let corrector = newton.step(&left, point.products(centre, Some(&predictor)));
        let [primal, dual] = point.longest(&corrector);
        let way = (PART_OF_WAY * primal.min(dual)).min(1.0);
        let next = point.after(&corrector, [way; 2]);
        // Rounding can make the equations nearly singular: the point before is a valid one.
        if next.a.iter().any(|a| !a.is_finite()) {
            break;
        }
        point = next;
    }
    Solution { coefficients: point.a, dwell_s: point.dwell_s }
}

/// Returns the first point.
fn start(problem: InteriorProblem<'_>, budget: Budget) -> InteriorPoint {
    let InteriorProblem { splines, constraints, scale_s, .. } = problem;
    let highest = constraints.desired.iter().copied().fold(0.0, f64::max);
    let (price, total_s) = match budget {
        Budget::TimeS(time_s) => (1.1 * highest, time_s),
        Budget::Price(price) => (price, scale_s),
    };
    let slack = constraints.desired.mapv(|q| (price - q).max(0.1 * highest));
    let each_s = total_s / (slack.len() as f64 + 1.0);
    InteriorPoint {
        a: vec![0.0; splines.sums.len()],
        c: 0.0,
        price,
        dwell_s: slack.mapv(|_| each_s),
        slack,
        beside_s: if let Budget::TimeS(_) = budget { each_s } else { 0.0 },
    }
}

/// Returns the remainder of (2) of the module.
fn left(problem: InteriorProblem<'_>, point: &InteriorPoint, budget: Budget) -> Left {
    let InteriorProblem { splines, constraints, .. } = problem;
    let mut stationary = constraints.along(&point.dwell_s);
    let stretched = splines.gram.product(&point.a);
    for (v, (g, u)) in stationary.iter_mut().zip(stretched.iter().zip(&splines.sums)) {
        *v -= g + point.c * u;
    }
    let time_s = match budget {
        Budget::TimeS(time_s) => time_s - point.dwell_s.sum() - point.beside_s,
        Budget::Price(_) => 0.0,
    };
    let mut feasible = constraints.at_places(&point.a);
    Zip::from(&mut feasible)
        .and(&point.slack)
        .and(&constraints.desired)
        .for_each(|v, s, q| *v = s + q - point.price - *v);
    Left { stationary, mean: -dot(&splines.sums, &point.a), time_s, feasible }
}

impl InteriorPoint {
    fn complementarity(&self, budget: Budget) -> f64 {
        let beside = match budget {
            Budget::TimeS(_) => self.beside_s * self.price,
            Budget::Price(_) => 0.0,
        };
        self.dwell_s.dot(&self.slack) + beside
    }

    /// Returns the changes of the products m s and m_0 Lambda that lead to `centre`, s nm^2/s: to first order, or to
    /// second order with the products of a step before.
    fn products(&self, centre: f64, step: Option<&Self>) -> (Array1<f64>, f64) {
        let mut target = centre - &self.dwell_s * &self.slack;
        let mut beside = centre - self.beside_s * self.price;
        if let Some(step) = step {
            target -= &(&step.dwell_s * &step.slack);
            beside -= step.beside_s * step.price;
        }
        (target, beside)
    }

    /// Returns the longest steps, at most 1, that keep the dwell times and the slack positive.
    fn longest(&self, step: &Self) -> [f64; 2] {
        let shorter =
            |longest: f64, v: &f64, d: &f64| if *d < 0.0 { longest.min(-v / d) } else { longest };
        let primal = Zip::from(&self.dwell_s).and(&step.dwell_s).fold(1.0, shorter);
        let dual = Zip::from(&self.slack).and(&step.slack).fold(1.0, shorter);
        [shorter(primal, &self.beside_s, &step.beside_s), shorter(dual, &self.price, &step.price)]
    }

    /// Returns the point after these parts of a step: of the dwell times, and of everything else.
    fn after(&self, step: &Self, [primal, dual]: [f64; 2]) -> Self {
        let a = self.a.iter().zip(&step.a).map(|(a, d)| a + dual * d).collect();
        Self {
            a,
            c: self.c + primal * step.c,
            price: self.price + dual * step.price,
            slack: &self.slack + &(dual * &step.slack),
            dwell_s: &self.dwell_s + &(primal * &step.dwell_s),
            beside_s: self.beside_s + primal * step.beside_s,
        }
    }
}

/// Newton's equations at a point, factorised.
struct Newton<'a> {
    problem: InteriorProblem<'a>,
    point: &'a InteriorPoint,
    /// False if Lambda is a price and no unknown.
    is_timed: bool,
    d: Array1<f64>,
    /// `m_0 / Lambda`.
    d_beside: f64,
    factor: Factor,
    /// `V D 1` and `(G + V D V')^-1 V D 1`.
    row_of_price: [Vec<f64>; 2],
    /// `(G + V D V')^-1 u`.
    solved_sums: Vec<f64>,
}

impl<'a> Newton<'a> {
    /// Factorises the equations; `None` if rounding has made them singular.
    fn new(problem: InteriorProblem<'a>, point: &'a InteriorPoint, budget: Budget) -> Option<Self> {
        let d = &point.dwell_s / &point.slack;
        let factor = problem.constraints.normal(&problem.splines.gram, &d).factorise()?;
        let row = problem.constraints.along(&d);
        let mut solved = row.clone();
        factor.solve(&mut solved);
        let mut solved_sums = problem.splines.sums.clone();
        factor.solve(&mut solved_sums);
        let is_timed = matches!(budget, Budget::TimeS(_));
        let d_beside = if is_timed { point.beside_s / point.price } else { 0.0 };
        Some(Self {
            problem,
            point,
            is_timed,
            d,
            d_beside,
            factor,
            row_of_price: [row, solved],
            solved_sums,
        })
    }

    /// Returns the step that makes what is left zero to first order, and changes the products m s and m_0 Lambda by
    /// `target`.
    fn step(&self, left: &Left, (target, target_beside): (Array1<f64>, f64)) -> InteriorPoint {
        let Self { problem, point, d, .. } = self;
        // w = target / s + D (what is left of the constraints)
        let w = target / &point.slack + d * &left.feasible;
        let InteriorProblem { splines, constraints, .. } = *problem;
        let mut x = constraints.along(&w);
        x.iter_mut().zip(&left.stationary).for_each(|(x, r)| *x += r);
        self.factor.solve(&mut x);
        let [row, solved_row] = &self.row_of_price;
        let u = &splines.sums;
        let w_beside = if self.is_timed { target_beside / point.price } else { 0.0 };
        // (V D 1)'da + (sum D + D_0) dLambda = sum w + w_0 - (what is left of T),   u'da = what is left of the mean
        let mean = left.mean - dot(u, &x);
        let [uu, ur] = [dot(u, &self.solved_sums), dot(u, solved_row)];
        let (price, c) = if self.is_timed {
            let rr = dot(row, solved_row) - d.sum() - self.d_beside;
            let ru = dot(row, &self.solved_sums);
            let time = left.time_s - w.sum() - w_beside + dot(row, &x);
            let determinant = -rr * uu + ru * ur;
            ((-time * uu - ru * mean) / determinant, (rr * mean + ur * time) / determinant)
        } else {
            (0.0, -mean / uu)
        };
        let columns = solved_row.iter().zip(&self.solved_sums);
        let a: Vec<f64> = x.iter().zip(columns).map(|(x, (r, u))| x - price * r - c * u).collect();
        let moved = constraints.at_places(&a) + price;
        InteriorPoint {
            c,
            price,
            slack: &moved - &left.feasible,
            dwell_s: w - d * &moved,
            beside_s: w_beside - self.d_beside * price,
            a,
        }
    }
}
