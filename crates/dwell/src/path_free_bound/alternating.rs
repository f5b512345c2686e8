//! The bound without splines, by alternating directions on all places of a lattice.
//!
//! The problem (2) of the module above, with a copy v of the removal at all nodes of a lattice and a copy u of the dwell
//! times at its places:
//!
//! ```text
//! min 1/2 |z - c - v|^2 over the valid pixels + h(u)   with   v = K m,   u = m                      (1)
//! h(u) = 0 if u >= 0 and sum u <= T, else infinite;   or the price times sum u, for u >= 0
//! ```
//!
//! With scaled multipliers a and b, a penalty rho and a weight sigma between the two equations, each step takes
//!
//! ```text
//! m = argmin |v + a - K m|^2 + sigma |u + b - m|^2 = t + K' (K K' + sigma)^-1 (v + a - K t),  t = u + b
//! v = argmin of (1) + rho/2 |v - k + a|^2,   u = argmin of (1) + rho sigma/2 |u - n + b|^2
//! k = ALPHA K m + (1 - ALPHA) v,             n = ALPHA m + (1 - ALPHA) u                           (2)
//! a += v - k,   b += u - n
//! ```
//!
//! K is a circular convolution on the lattice, so the step for m is a division in the frequency domain. `rho a` goes to
//! e, the residual of the best dwell times.
//!
//! Source: S. Boyd et al., Found. Trends Mach. Learn. 3 (2011) 1, sections 3.3 (residuals), 3.4.1 (penalty) and 3.4.3
//! (over-relaxation).

use ndarray::{Array2, Zip, s};
use planish_numerics::fft::{Complex64, convolution::Convolution, smooth_size};

use super::{
    Budget,
    tool::{LatticeTool, PartPixels, product, squares},
};

/// Over-relaxation of (2), between 1 and 2. Boyd et al. advise 1.5 to 1.8.
const ALPHA: f64 = 1.6;

/// sigma, relative to the square of the largest gain of the tool. Larger: dwell times change slowly. Smaller: they swing.
const WEIGHT: f64 = 3e-3;

/// rho at the start. It then follows the residuals.
const FIRST_PENALTY: f64 = 1e-2;

/// Steps between two looks at the residuals, which change rho, and at the gap. Larger: a rho that fits less. Smaller:
/// time, and a rho that swings.
const STEPS_BETWEEN_LOOKS: usize = 50;

/// Largest number of steps. Larger: a larger bound. Smaller: less time.
const MOST_STEPS: usize = 1000;

/// Gap at the nodes at which the steps end. Larger: a smaller bound. Smaller: more steps.
const SMALL_GAP: f64 = 5e-3;

/// Dwell times on the places of a lattice, and the residual e that goes with them.
pub struct Directions {
    /// e (ny, nx), nm.
    pub residual_nm: Array2<f64>,
    /// Dwell times at the places, s.
    pub dwell_s: Array2<f64>,
}

/// The state of (2) on a lattice.
struct State<'a> {
    part: &'a PartPixels,
    tool: &'a LatticeTool,
    convolution: Convolution,
    sigma: f64,
    rho: f64,
    v: Array2<f64>,
    a: Array2<f64>,
    u: Array2<f64>,
    b: Array2<f64>,
}

/// Finds dwell times and a residual near the best ones.
pub fn solve(part: &PartPixels, tool: &LatticeTool, budget: Budget) -> Directions {
    let mut state = State::new(part, tool);
    for step in 1..=MOST_STEPS {
        let [primal, dual] = state.step(budget);
        if step % STEPS_BETWEEN_LOOKS == 0 {
            let found = state.found();
            if found.gap(part, tool, budget) < SMALL_GAP {
                return found;
            }
            state.balance(primal, dual);
        }
    }
    state.found()
}

impl Directions {
    /// Returns the gap between the bound by e, with its adjoint at the places alone, and what the dwell times leave.
    fn gap(&self, part: &PartPixels, tool: &LatticeTool, budget: Budget) -> f64 {
        let Self { residual_nm, dwell_s } = self;
        let q = tool.adjoint(residual_nm, 0).iter().copied().fold(0.0, f64::max);
        let along = product(residual_nm, &part.desired_nm) - budget.time_s(dwell_s.sum()) * q;
        let left = part.residual_nm(tool.removal_nm(std::slice::from_ref(dwell_s)));
        1.0 - along / (squares(residual_nm) * squares(&left)).sqrt()
    }
}

impl<'a> State<'a> {
    fn new(part: &'a PartPixels, tool: &'a LatticeTool) -> Self {
        let (rows, columns) = tool.places(part);
        let shape = (smooth_size(rows), smooth_size(columns));
        // Rates are not negative: the largest gain is that of a constant.
        let gain = tool.samples().sum();
        let [v, a, u, b] = [0; 4].map(|_| Array2::zeros(shape));
        let convolution = Convolution::new(tool.samples().view(), shape);
        let sigma = WEIGHT * gain * gain;
        Self { part, tool, convolution, sigma, rho: FIRST_PENALTY, v, a, u, b }
    }

    /// Returns a map on the lattice after a filter of the gain of the tool at each frequency, and sigma.
    fn filtered(
        &self,
        map: &Array2<f64>,
        filter: impl Fn(Complex64, f64) -> Complex64 + Sync,
    ) -> Array2<f64> {
        self.convolution.periodic(map.view(), |g| filter(g, self.sigma))
    }

    /// Takes the step (2). Returns the norms of the primal and of the dual residual, each relative to its scale.
    fn step(&mut self, budget: Budget) -> [f64; 2] {
        let Self { part, tool, rho, .. } = *self;
        let t = &self.u + &self.b;
        let misses = &self.v + &self.a - self.filtered(&t, |g, _| g);
        let m = t + self.filtered(&misses, |g, sigma| g.conj() / (g.norm_sqr() + sigma));
        let removal = self.filtered(&m, |g, _| g);
        let primal = squared(&self.v, &removal) + self.sigma * squared(&self.u, &m);

        let k = ALPHA * removal + (1.0 - ALPHA) * &self.v;
        let n = ALPHA * m + (1.0 - ALPHA) * &self.u;
        let mut v = &k - &self.a;
        let left = part.residual_nm(tool.pixels_of(&mut v, part).to_owned());
        let mut on_pixels = tool.pixels_of(&mut v, part);
        on_pixels.scaled_add(1.0 / (1.0 + rho), &left);
        let mut u = Array2::zeros(n.dim());
        let (rows, columns) = tool.places(part);
        let places = s![..rows, ..columns];
        let free = &n.slice(places) - &self.b.slice(places);
        u.slice_mut(places).assign(&budget.nearest_s(free, rho * self.sigma));
        let dual = squared(&self.v, &v) + self.sigma * squared(&self.u, &u);

        self.a += &(&v - &k);
        self.b += &(&u - &n);
        (self.v, self.u) = (v, u);
        let scales = [
            squares(&self.v) + self.sigma * squares(&self.u),
            squares(&self.a) + self.sigma * squares(&self.b),
        ];
        [(primal / scales[0]).sqrt(), (dual / scales[1]).sqrt()]
    }

    /// Changes rho so that both residuals fall alike. It stays where both are 0.
    fn balance(&mut self, primal: f64, dual: f64) {
        let factor = (primal / dual).sqrt().clamp(0.2, 5.0);
        if factor.is_nan() || (0.5..=2.0).contains(&factor) {
            return;
        }
        self.rho *= factor;
        self.a /= factor;
        self.b /= factor;
    }

    /// Returns the dwell times and the residual of this state.
    fn found(&mut self) -> Directions {
        let (rows, columns) = self.tool.places(self.part);
        let removal_nm = self.tool.pixels_of(&mut self.v, self.part).to_owned();
        Directions {
            residual_nm: self.part.residual_nm(removal_nm),
            dwell_s: self.u.slice(s![..rows, ..columns]).to_owned(),
        }
    }
}

/// Returns the square of the distance of two maps.
fn squared(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    Zip::from(a).and(b).fold(0.0, |sum, a, b| sum + (a - b) * (a - b))
}

#[cfg(test)]
mod tests {
    use planish_types::{Axis, Grid, Surface, Tif};

    use super::*;

    #[test]
    fn dwell_times_keep_the_budget_and_the_residual_nearly_proves_them_the_best() {
        let axis = |count| Axis::new(0.0, 0.5, count).unwrap();
        let grid = Grid { x: axis(25), y: axis(18) };
        let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let rough = if (r * 7 + c * 3) % 5 == 0 { 2.0 } else { 0.0 };
            if r + c < 4 {
                f64::NAN
            } else {
                10.0 * (0.4 * c as f64).sin() * (0.3 * r as f64).cos() + rough
            }
        });
        let surface = Surface::new(grid, height).unwrap();
        // A spot that is narrow across, and steeper at one end.
        let around = |half: f64| Axis::new(-half, 0.5, (4.0 * half) as usize + 1).unwrap();
        let spot = Grid { x: around(2.5), y: around(1.5) };
        let rate = Array2::from_shape_fn(spot.shape(), |(r, c)| {
            let [x, y] = [spot.x.coordinate_mm(c), spot.y.coordinate_mm(r)];
            (-2.0 * y * y).exp() * (2.5 + x) * (-x * x / if x > 0.0 { 0.5 } else { 2.0 }).exp()
        });
        let tif = Tif::new(spot, rate).unwrap();
        let part = PartPixels::new(&surface);
        let tool = LatticeTool::new(&tif, &grid, 0.125);
        for (budget, most_s) in [(Budget::TimeS(40.0), 40.0), (Budget::Price(20.0), f64::INFINITY)]
        {
            let found = solve(&part, &tool, budget);
            assert!(found.dwell_s.iter().all(|t| *t >= 0.0));
            let time_s = budget.time_s(found.dwell_s.sum());
            // Sums of some thousand numbers.
            assert!(time_s > 0.0 && found.dwell_s.sum() <= most_s * (1.0 + 1e-12), "{time_s}");
            // The steps end there.
            assert!(found.gap(&part, &tool, budget) < SMALL_GAP);
        }
    }
}
