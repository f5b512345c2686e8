//! Jets: numbers with their first and second derivatives by x and y (forward differentiation).
//!
//! ```text
//! (f g)_xy = f_xy g + f_x g_y + f_y g_x + f g_xy
//! (h o f)_xy = h'(f) f_xy + h''(f) f_x f_y
//! ```

use std::ops::{Add, Div, Mul, Sub};

/// A value f(x, y) at a point, and its derivatives by x and y.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Jet {
    /// Value at the point; for a height in mm.
    pub value: f64,
    /// First derivatives by [x, y]; for a height in mm/mm.
    pub gradient: [f64; 2],
    /// Second derivatives [xx, xy, yy]; for a height in 1/mm.
    pub hessian: [f64; 3],
}

impl Jet {
    /// Returns a number that does not depend on x and y: all derivatives are 0.
    pub fn constant(value: f64) -> Self {
        Self { value, ..Self::default() }
    }

    /// Returns the coordinates x and y of a point as functions of themselves.
    pub fn coordinates([x, y]: [f64; 2]) -> [Self; 2] {
        [
            Self { value: x, gradient: [1.0, 0.0], hessian: [0.0; 3] },
            Self { value: y, gradient: [0.0, 1.0], hessian: [0.0; 3] },
        ]
    }

    /// Returns h(f, g) of two functions f and g. The array contains h and its derivatives [h, h_f, h_g, h_ff, h_fg,
    /// h_gg] at their values. The second derivatives follow from `h_xy = h_f f_xy + h_g g_xy + h_ff f_x f_y + h_fg (f_x
    /// g_y + f_y g_x) + h_gg g_x g_y`.
    pub(crate) fn composed([h, hf, hg, hff, hfg, hgg]: [f64; 6], [f, g]: [Self; 2]) -> Self {
        Self {
            value: h,
            gradient: [0, 1].map(|k| hf * f.gradient[k] + hg * g.gradient[k]),
            hessian: [(0, 0, 0), (1, 0, 1), (2, 1, 1)].map(|(k, i, j)| {
                let [a, b] = [f.gradient[i], f.gradient[j]];
                let [c, d] = [g.gradient[i], g.gradient[j]];
                hf * f.hessian[k]
                    + hg * g.hessian[k]
                    + hff * a * b
                    + hfg * (a * d + b * c)
                    + hgg * c * d
            }),
        }
    }

    /// Returns h(f) of this number f. The array contains h, h' and h'' at its value.
    fn chained(self, [h, first, second]: [f64; 3]) -> Self {
        let [x, y] = self.gradient;
        let products = [x * x, x * y, y * y];
        Self {
            value: h,
            gradient: [first * x, first * y],
            hessian: [0, 1, 2].map(|k| first * self.hessian[k] + second * products[k]),
        }
    }

    /// Returns the square root; its value is NaN for a negative number.
    pub fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        self.chained([root, 0.5 / root, -0.25 / (root * self.value)])
    }

    /// Returns this number times the constant `factor`.
    pub fn times(self, factor: f64) -> Self {
        self * Self::constant(factor)
    }

    /// Returns this number to the power `exponent`.
    pub fn power(self, exponent: u32) -> Self {
        (0..exponent).fold(Self::constant(1.0), |product, _| product * self)
    }

    /// Returns true if the value and all derivatives are finite.
    pub fn is_finite(&self) -> bool {
        let derivatives = self.gradient.iter().chain(&self.hessian);
        self.value.is_finite() && derivatives.into_iter().all(|v| v.is_finite())
    }
}

impl Add for Jet {
    type Output = Self;
    fn add(self, g: Self) -> Self {
        Self {
            value: self.value + g.value,
            gradient: [0, 1].map(|k| self.gradient[k] + g.gradient[k]),
            hessian: [0, 1, 2].map(|k| self.hessian[k] + g.hessian[k]),
        }
    }
}

impl Sub for Jet {
    type Output = Self;
    fn sub(self, g: Self) -> Self {
        self + g.times(-1.0)
    }
}

impl Mul for Jet {
    type Output = Self;
    fn mul(self, g: Self) -> Self {
        let ([fx, fy], [gx, gy]) = (self.gradient, g.gradient);
        let cross = [2.0 * fx * gx, fx * gy + fy * gx, 2.0 * fy * gy];
        Self {
            value: self.value * g.value,
            gradient: [0, 1].map(|k| self.gradient[k] * g.value + self.value * g.gradient[k]),
            hessian: [0, 1, 2]
                .map(|k| self.hessian[k] * g.value + cross[k] + self.value * g.hessian[k]),
        }
    }
}

impl Div for Jet {
    type Output = Self;
    fn div(self, g: Self) -> Self {
        let inverse = 1.0 / g.value;
        self * g.chained([inverse, -inverse * inverse, 2.0 * inverse.powi(3)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// f = sqrt(1 + x^2 y) / (2 + x y), differentiated by hand.
        #[test]
        fn derivatives_are_those_of_calculus(x in -1.0..1.0_f64, y in 0.0..1.0_f64) {
            let [jx, jy] = Jet::coordinates([x, y]);
            let (one, two) = (Jet::constant(1.0), Jet::constant(2.0));
            let f = (one + jx * jx * jy).sqrt() / (two + jx * jy);
            let (r, q) = ((1.0 + x * x * y).sqrt(), 2.0 + x * y);
            let (rx, ry) = (x * y / r, 0.5 * x * x / r);
            let rxx = y / r - x * x * y * y / r.powi(3);
            let gx = rx / q - r * y / (q * q);
            let gxx = rxx / q - 2.0 * rx * y / (q * q) + 2.0 * r * y * y / q.powi(3);
            let gy = ry / q - r * x / (q * q);
            // A few roundings of numbers of about 1.
            prop_assert!((f.value - r / q).abs() < 1e-15);
            prop_assert!((f.gradient[0] - gx).abs() < 1e-14 && (f.gradient[1] - gy).abs() < 1e-14);
            prop_assert!((f.hessian[0] - gxx).abs() < 1e-14, "{} {gxx}", f.hessian[0]);
            // The mixed derivative by a central difference of gx by y: h^2 / 6 = 2e-11 times a derivative of about 1.
            let h = 1e-5;
            let at = |y: f64| {
                let (r, q) = ((1.0 + x * x * y).sqrt(), 2.0 + x * y);
                x * y / r / q - r * y / (q * q)
            };
            let mixed = (at(y + h) - at(y - h)) / (2.0 * h);
            prop_assert!((f.hessian[1] - mixed).abs() < 1e-9, "{} {mixed}", f.hessian[1]);
        }
    }
}
