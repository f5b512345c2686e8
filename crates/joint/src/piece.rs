//! Pieces of a curve: clothoids, of which lines and circular arcs are special cases
//! ([`planish_numerics::motion::clothoid`]).

use planish_numerics::motion::clothoid;

/// Position, direction and curvature at a point of a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Station {
    /// Position [x, y], mm.
    pub point_mm: [f64; 2],
    /// Unit vector along the curve.
    pub tangent: [f64; 2],
    /// Curvature, positive to the left, 1/mm.
    pub curvature_per_mm: f64,
}

/// Piece of a curve whose curvature is linear in the arc length (a clothoid).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CurvePiece {
    /// Position, direction and curvature at its start.
    pub start: Station,
    /// Change of the curvature per length, 1/mm^2.
    pub sharpness_per_mm2: f64,
    /// Arc length of its start from the start of the curve, mm.
    pub from_mm: f64,
    /// Arc length of the piece, mm.
    pub length_mm: f64,
    /// Index of the segment of the tool path that it follows.
    pub segment: usize,
}

impl CurvePiece {
    /// Returns position, direction and curvature at the length `s` from the start of the piece, mm.
    pub fn station(&self, s: f64) -> Station {
        let Station { point_mm, tangent, curvature_per_mm } = self.start;
        let [along, across] = clothoid::position(curvature_per_mm, self.sharpness_per_mm2, s);
        let step =
            [tangent[0] * along - tangent[1] * across, tangent[1] * along + tangent[0] * across];
        let (tangent, curvature_per_mm) = self.direction(s);
        let point_mm = [point_mm[0] + step[0], point_mm[1] + step[1]];
        Station { point_mm, tangent, curvature_per_mm }
    }

    /// Returns the unit vector along the curve, and the curvature (1/mm), at the length `s` from the start of the
    /// piece, mm.
    pub fn direction(&self, s: f64) -> ([f64; 2], f64) {
        let Station { tangent, curvature_per_mm: curvature, .. } = self.start;
        let (sin, cos) = clothoid::heading(curvature, self.sharpness_per_mm2, s).sin_cos();
        let turned = [tangent[0] * cos - tangent[1] * sin, tangent[1] * cos + tangent[0] * sin];
        (turned, curvature + self.sharpness_per_mm2 * s)
    }

    /// Returns true if the piece is a straight line.
    pub fn is_straight(&self) -> bool {
        self.start.curvature_per_mm == 0.0 && self.sharpness_per_mm2 == 0.0
    }

    /// Returns the magnitude of the change of the heading along the piece, rad.
    pub fn turn_rad(&self) -> f64 {
        clothoid::heading(self.start.curvature_per_mm, self.sharpness_per_mm2, self.length_mm).abs()
    }

    /// Returns the curvature at the start and at the end of the piece, 1/mm, positive to the left.
    pub fn curvatures_per_mm(&self) -> [f64; 2] {
        let from = self.start.curvature_per_mm;
        [from, from + self.sharpness_per_mm2 * self.length_mm]
    }

    /// Returns the largest magnitude of the curvature, 1/mm.
    pub fn most_curvature_per_mm(&self) -> f64 {
        let [from, to] = self.curvatures_per_mm();
        from.abs().max(to.abs())
    }

    /// Returns the ratio of the change of the curvature along the piece to its largest magnitude; 0 on a straight line.
    pub fn change_of_curvature(&self) -> f64 {
        let [from, to] = self.curvatures_per_mm();
        let most = from.abs().max(to.abs());
        if most > 0.0 { (to - from).abs() / most } else { 0.0 }
    }

    /// Returns the bend of the piece: the integral of the square root of the magnitude of its curvature, mm^(1/2).
    pub fn bend(&self) -> f64 {
        let [from, to] = self.curvatures_per_mm();
        let a = from.abs().sqrt();
        let b = to.abs().sqrt();
        let mean = if from * to < 0.0 {
            // Two ramps from 0
            (a.powi(3) + b.powi(3)) / (a * a + b * b)
        } else if a + b > 0.0 {
            // (b^3 - a^3) / (b^2 - a^2), without its pole at a = b
            (a * a + a * b + b * b) / (a + b)
        } else {
            0.0
        };
        2.0 / 3.0 * self.length_mm * mean
    }

    /// Returns the arc length of the end of the piece from the start of the curve, mm.
    pub fn to_mm(&self) -> f64 {
        self.from_mm + self.length_mm
    }
}
