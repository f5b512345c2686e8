//! Numbers with their first and second derivatives by one parameter (forward differentiation).
//!
//! ```text
//! (f g)'' = f'' g + 2 f' g' + f g''
//! atan2(y, x)' = (x y' - y x') / (x^2 + y^2)
//! ```

use std::ops::{Add, Div, Mul, Neg, Sub};

/// Value with its derivatives by a parameter: time, or arc length.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Series {
    /// Value, in any unit.
    pub value: f64,
    /// First derivative by the parameter.
    pub first: f64,
    /// Second derivative by the parameter.
    pub second: f64,
}

impl Series {
    /// Returns a value that does not depend on the parameter: both derivatives are 0.
    pub fn constant(value: f64) -> Self {
        Self { value, ..Self::default() }
    }

    /// Returns the value and its derivatives times a factor.
    pub fn times(self, factor: f64) -> Self {
        Self {
            value: factor * self.value,
            first: factor * self.first,
            second: factor * self.second,
        }
    }

    /// Returns the square root of a positive number: `r^2 = f` gives `2 r r' = f'` and `2 r r'' = f'' - 2 r'^2`.
    pub(crate) fn sqrt(self) -> Self {
        let value = self.value.sqrt();
        let first = 0.5 * self.first / value;
        Self { value, first, second: (0.5 * self.second - first * first) / value }
    }

    /// Returns the angle of the direction (x, y), rad, from -pi to pi. The derivatives are not finite for (0, 0).
    pub(crate) fn angle([x, y]: [Self; 2]) -> Self {
        let square = x.value * x.value + y.value * y.value;
        let first = (x.value * y.first - y.value * x.first) / square;
        // The derivative of the numerator, minus that of the denominator times the quotient.
        let numerator = x.value * y.second - y.value * x.second;
        let denominator = 2.0 * (x.value * x.first + y.value * y.first);
        let second = (numerator - first * denominator) / square;
        Self { value: y.value.atan2(x.value), first, second }
    }
}

impl Add for Series {
    type Output = Self;
    fn add(self, g: Self) -> Self {
        Self {
            value: self.value + g.value,
            first: self.first + g.first,
            second: self.second + g.second,
        }
    }
}

impl Neg for Series {
    type Output = Self;
    fn neg(self) -> Self {
        self.times(-1.0)
    }
}

impl Sub for Series {
    type Output = Self;
    fn sub(self, g: Self) -> Self {
        self + -g
    }
}

impl Mul for Series {
    type Output = Self;
    fn mul(self, g: Self) -> Self {
        Self {
            value: self.value * g.value,
            first: self.first * g.value + self.value * g.first,
            second: self.second * g.value + 2.0 * self.first * g.first + self.value * g.second,
        }
    }
}

impl Div for Series {
    type Output = Self;
    /// Divides: `q g = f` gives `q' = (f' - q g') / g` and `q'' = (f'' - 2 q' g' - q g'') / g`.
    fn div(self, g: Self) -> Self {
        let value = self.value / g.value;
        let first = (self.first - value * g.first) / g.value;
        let second = (self.second - 2.0 * first * g.first - value * g.second) / g.value;
        Self { value, first, second }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the parameter t itself at the value `t`.
    fn parameter(t: f64) -> Series {
        Series { value: t, first: 1.0, second: 0.0 }
    }

    #[test]
    fn products_quotients_and_roots_have_the_derivatives_of_their_formulas() {
        let t = parameter(3.0);
        let square = t * t;
        assert_eq!(square, Series { value: 9.0, first: 6.0, second: 2.0 });
        // t^2 / t = t, sqrt(t^2) = t, to rounding.
        for same in [square / t, square.sqrt()] {
            let off = same - t;
            assert!([off.value, off.first, off.second].iter().all(|v| v.abs() < 1e-15), "{same:?}");
        }
    }

    #[test]
    fn the_angle_of_a_parabola_has_the_derivatives_of_the_arc_tangent() {
        // atan(u) with u = t^2: u' / (1 + u^2), (u'' (1 + u^2) - 2 u u'^2) / (1 + u^2)^2.
        let t = parameter(0.7);
        let angle = Series::angle([Series::constant(1.0), t * t]);
        let (u, du, ddu) = (0.49_f64, 1.4, 2.0);
        let w = 1.0 + u * u;
        let expected = [u.atan(), du / w, (ddu * w - 2.0 * u * du * du) / (w * w)];
        for (found, expected) in [angle.value, angle.first, angle.second].iter().zip(expected) {
            // Rounding of numbers of the order 1.
            assert!((found - expected).abs() < 1e-15, "{angle:?}");
        }
    }
}
