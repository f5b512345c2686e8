//! The best dwell times at all places of the lattice, by accelerated projected gradient steps.
//!
//! ```text
//! min over m >= 0:  1/2 |e|^2,  e = z - c - K m,  sum m <= T          (with a price: + Lambda sum m)     (1)
//! m+ = max(0, y + (K'e(y) - nu) / d),   d = K'K 1,   nu >= 0 such that sum m+ <= T                    (2)
//! ```
//!
//! d is at least the curvature, because no element of K is below 0 but for noise. With a price, nu is that price. The
//! steps extrapolate (y), and start again where that leads uphill.
//!
//! Source: A. Beck and M. Teboulle, SIAM J. Imaging Sci. 2 (2009) 183; restart: B. O'Donoghue and E. Candes, Found.
//! Comput. Math. 15 (2015) 715.

use ndarray::{Array2, Zip};

use super::{
    Budget,
    tool::{LatticeTool, PartPixels, product},
};

/// Smallest d relative to the largest. Larger: places at the rim change more slowly. Smaller: rounding there.
const LEAST_CURVATURE: f64 = 1e-3;

/// Largest number of Newton steps for nu; each is exact as long as the same places are above 0.
const STEPS_OF_PRICE: usize = 60;

/// Dwell times at the places, with what the steps need.
pub struct Descent<'a> {
    part: &'a PartPixels,
    tool: &'a LatticeTool,
    budget: Budget,
    curvature: Array2<f64>,
    /// Dwell times m at all places, s.
    pub dwell_s: Array2<f64>,
    ahead: Array2<f64>,
    momentum: f64,
    price: f64,
}

impl<'a> Descent<'a> {
    /// Begins with these dwell times at all places, s.
    pub fn new(
        part: &'a PartPixels,
        tool: &'a LatticeTool,
        budget: Budget,
        dwell_s: Array2<f64>,
    ) -> Self {
        let everywhere = Array2::ones(dwell_s.dim());
        let mut curvature = tool.adjoint(&part.on_valid(tool.removal_nm(&everywhere)), 0);
        let largest = curvature.iter().copied().fold(0.0, f64::max);
        curvature.mapv_inplace(|d| d.max(LEAST_CURVATURE * largest));
        let price = match budget {
            Budget::TimeS(_) => 0.0,
            Budget::Price(price) => price,
        };
        let ahead = dwell_s.clone();
        Self { part, tool, budget, curvature, dwell_s, ahead, momentum: 1.0, price }
    }

    /// Returns the residual (ny, nx) without mean, nm.
    pub fn residual_nm(&self) -> Array2<f64> {
        self.part.residual_nm(self.tool.removal_nm(&self.dwell_s))
    }

    /// Makes one step (2).
    pub fn advance(&mut self) {
        let residual = self.part.residual_nm(self.tool.removal_nm(&self.ahead));
        let adjoint = self.tool.adjoint(&residual, 0);
        let mut next = &self.ahead + &(&adjoint / &self.curvature);
        if let Budget::TimeS(time_s) = self.budget {
            self.price = self.price_for(&next, time_s);
        }
        let price = self.price;
        Zip::from(&mut next).and(&self.curvature).for_each(|m, d| *m = (*m - price / d).max(0.0));
        let moved = &next - &self.dwell_s;
        // The gradient, and the change of the dwell times, in the same direction: uphill.
        if product(&adjoint, &moved) < price * moved.sum() {
            self.momentum = 1.0;
        }
        let momentum = 0.5 * (1.0 + (1.0 + 4.0 * self.momentum * self.momentum).sqrt());
        self.ahead = &next + &((self.momentum - 1.0) / momentum * moved);
        self.momentum = momentum;
        self.dwell_s = next;
    }

    /// Returns nu of (2) for `sum m+ <= time_s`.
    fn price_for(&self, unpriced: &Array2<f64>, time_s: f64) -> f64 {
        let mut price = 0.0;
        // The sum is convex and falls with nu: Newton's method from below never passes the solution.
        for _ in 0..STEPS_OF_PRICE {
            let (sum, slope) =
                Zip::from(unpriced).and(&self.curvature).fold((0.0, 0.0), |(sum, slope), m, d| {
                    let above = m - price / d;
                    if above > 0.0 { (sum + above, slope + 1.0 / d) } else { (sum, slope) }
                });
            if sum <= time_s * (1.0 + 1e-12) || slope == 0.0 {
                break;
            }
            price += (sum - time_s) / slope;
        }
        price
    }
}
