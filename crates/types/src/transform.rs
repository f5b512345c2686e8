//! Position of a part: transform from the coordinates of its map to those of a machine or of
//! another map.

use serde::{Deserialize, Serialize};

use crate::{Invalid, ToolPath, Trajectory, is_plausible_mm};

/// Largest magnitude of an element of the matrix M and largest scale, dimensionless; the smallest scale is its inverse.
/// Larger: mistaken units pass. Smaller: real scales are refused. Chosen: part and machine have the same unit, so that
/// a factor of ten is a mistake.
const LARGEST_SCALE: f64 = 10.0;

/// Affine transform `q = M (p - centre) + image` from a point p of the part to a point q of the machine, mm.
///
/// M mirrors if the axes of the machine are left-handed, seen from above the part.
///
/// The covariance is that of the six numbers (image x, image y in mm; M xx, xy, yx, yy). It has
/// rank 6 for an affine transform and rank 3 for a rigid one.
#[derive(Clone, Debug, PartialEq)]
pub struct Transform {
    matrix: [[f64; 2]; 2],
    centre_mm: [f64; 2],
    image_mm: [f64; 2],
    covariance: [[f64; 6]; 6],
}

impl Transform {
    /// Returns the transform. Refuses numbers that are not finite, scales above 10 or below 0.1, and a covariance that
    /// is not symmetric or has negative variances.
    pub fn new(
        matrix: [[f64; 2]; 2],
        centre_mm: [f64; 2],
        image_mm: [f64; 2],
        covariance: [[f64; 6]; 6],
    ) -> Result<Self, Invalid> {
        for (name, point) in [("centre_mm", centre_mm), ("image_mm", image_mm)] {
            if let Some(a) = point.iter().position(|v| !is_plausible_mm(*v)) {
                let remedy = "give finite coordinates in mm, within 1e7 mm of the origin";
                return Err(Invalid::at_index(name, a, format!("is {}", point[a]), remedy));
            }
        }
        let [[a, b], [c, d]] = matrix;
        let determinant = a * d - b * c;
        let range = LARGEST_SCALE.powi(-2)..=LARGEST_SCALE.powi(2);
        let within = matrix.iter().flatten().all(|v| v.abs() <= LARGEST_SCALE);
        if !(within && range.contains(&determinant.abs())) {
            let problem = format!("is {matrix:?}, with the determinant {determinant}");
            let remedy = "give a rotation, a similarity or an affine matrix, about 1 in size";
            return Err(Invalid::whole("matrix", problem, remedy));
        }
        for i in 0..6 {
            for j in 0..6 {
                let v = covariance[i][j];
                let apart = (v - covariance[j][i]).abs();
                // Symmetric to rounding; variances are not negative.
                let wide = (covariance[i][i] * covariance[j][j]).abs().sqrt();
                if !v.is_finite() || (i == j && v < 0.0) || apart > 1e-9 * wide {
                    let problem = format!("is {v}");
                    return Err(Invalid::at_index(
                        "covariance_mm2",
                        (i, j),
                        problem,
                        "give a covariance",
                    ));
                }
            }
        }
        Ok(Self { matrix, centre_mm, image_mm, covariance })
    }

    /// Returns the matrix M, dimensionless.
    pub fn matrix(&self) -> &[[f64; 2]; 2] {
        &self.matrix
    }

    /// Returns the reference point [x, y] of the part, about which M turns, mm.
    pub fn centre_mm(&self) -> [f64; 2] {
        self.centre_mm
    }

    /// Returns the image of the reference point on the machine, mm.
    pub fn image_mm(&self) -> [f64; 2] {
        self.image_mm
    }

    /// Returns the covariance of (image x, image y, M xx, xy, yx, yy), in products of mm and 1.
    pub fn covariance(&self) -> &[[f64; 6]; 6] {
        &self.covariance
    }

    /// Returns true if the matrix M turns the part over (negative determinant).
    pub fn mirrors(&self) -> bool {
        let [[a, b], [c, d]] = self.matrix;
        a * d < b * c
    }

    /// Returns the angle by which the matrix M turns x towards y, rad. If M is no rotation, it is the angle of the
    /// nearest one. If M mirrors, it is the angle after y of the part was turned over.
    pub fn angle_rad(&self) -> f64 {
        let sign = if self.mirrors() { -1.0 } else { 1.0 };
        let [[a, b], [c, d]] = self.matrix;
        (c - sign * b).atan2(a + sign * d)
    }

    /// Returns the scale of the matrix M, dimensionless: the square root of the magnitude of its determinant.
    pub fn scale(&self) -> f64 {
        let [[a, b], [c, d]] = self.matrix;
        (a * d - b * c).abs().sqrt()
    }

    /// Returns the largest factor by which the matrix M stretches a length: its larger singular value.
    pub fn largest_stretch(&self) -> f64 {
        let [[a, b], [c, d]] = self.matrix;
        0.5 * ((a + d).hypot(c - b) + (a - d).hypot(c + b))
    }

    /// Returns the image M v of a direction [x, y] of the part, in the unit of v.
    pub fn direction(&self, v: [f64; 2]) -> [f64; 2] {
        self.matrix.map(|row| row[0] * v[0] + row[1] * v[1])
    }

    /// Returns the image q = M (p - centre) + image of a point p [x, y] of the part, mm.
    pub fn point(&self, p: [f64; 2]) -> [f64; 2] {
        let v = self.direction([p[0] - self.centre_mm[0], p[1] - self.centre_mm[1]]);
        [v[0] + self.image_mm[0], v[1] + self.image_mm[1]]
    }

    /// Returns the standard errors of the image of the point p [x, y], along x and y of the machine, mm.
    pub fn standard_error_mm(&self, p: [f64; 2]) -> [f64; 2] {
        let d = [p[0] - self.centre_mm[0], p[1] - self.centre_mm[1]];
        // q_x = image_x + M_xx d_x + M_xy d_y
        let rows = [[1.0, 0.0, d[0], d[1], 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, d[0], d[1]]];
        rows.map(|row| self.variance(&row).sqrt())
    }

    /// Returns the variance of a quantity, at least 0. `gradient` contains its derivatives by the six numbers of
    /// [`Self::covariance`].
    pub fn variance(&self, gradient: &[f64; 6]) -> f64 {
        let mut sum = 0.0;
        for i in 0..6 {
            for j in 0..6 {
                sum += gradient[i] * self.covariance[i][j] * gradient[j];
            }
        }
        sum.max(0.0)
    }

    /// Returns the transform from the machine to the part, with its covariance to first order. Refuses a reference
    /// point or an image beyond 1e7 mm.
    pub fn inverse(&self) -> Result<Self, Invalid> {
        // p = N (q - image) + centre with N = M^-1:  dN = -N dM N,  d centre = -N d image
        let [[a, b], [c, d]] = self.matrix;
        let determinant = a * d - b * c;
        let n = [[d / determinant, -b / determinant], [-c / determinant, a / determinant]];
        let mut jacobian = [[0.0; 6]; 6];
        for r in 0..2 {
            for s in 0..2 {
                jacobian[r][s] = -n[r][s];
                for (i, j) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    jacobian[2 + 2 * r + s][2 + 2 * i + j] = -n[r][i] * n[j][s];
                }
            }
        }
        let mut covariance = [[0.0; 6]; 6];
        for i in 0..6 {
            for j in 0..=i {
                let mut sum = 0.0;
                for k in 0..6 {
                    for l in 0..6 {
                        sum += jacobian[i][k] * self.covariance[k][l] * jacobian[j][l];
                    }
                }
                covariance[i][j] = sum;
                covariance[j][i] = sum;
            }
            covariance[i][i] = covariance[i][i].max(0.0);
        }
        Self::new(n, self.image_mm, self.centre_mm, covariance)
    }

    /// Returns the tool path in machine coordinates. Its points are transformed; tool flags and passes stay. Refuses
    /// points beyond 1e7 mm.
    pub fn tool_path(&self, path: &ToolPath) -> Result<ToolPath, Invalid> {
        let [points, dwell_points] = [path.point_mm(), path.dwell_point_mm()]
            .map(|points| points.iter().map(|p| self.point(*p)).collect());
        ToolPath::new(points, dwell_points, path.tool_on().to_vec(), path.pass_idx().to_vec())
    }

    /// Returns the motion in machine coordinates. A cubic stays a cubic: c0 transforms as a point, c1 to c3
    /// as directions. Refuses coefficients that are not finite.
    pub fn trajectory(&self, motion: &Trajectory) -> Result<Trajectory, Invalid> {
        let motion_of_machine = Trajectory::new(
            motion.break_time_s().to_vec(),
            motion.coefficient_mm().iter().map(|c| self.polynomial(c)).collect(),
            motion.tool_on().to_vec(),
            motion.dwell_index().to_vec(),
        )?;
        match motion.rate_factor() {
            Some(factor) => motion_of_machine.with_rate_factor(factor.to_vec()),
            None => Ok(motion_of_machine),
        }
    }

    /// Returns the coefficients (axis, order) in machine coordinates of a cubic in coordinates of the part.
    fn polynomial(&self, c: &[[f64; 4]; 2]) -> [[f64; 4]; 2] {
        let mut image = [[0.0; 4]; 2];
        for order in 0..4 {
            let v = [c[0][order], c[1][order]];
            let [x, y] = if order == 0 { self.point(v) } else { self.direction(v) };
            image[0][order] = x;
            image[1][order] = y;
        }
        image
    }
}

/// A transform without its covariance, as manifests and the files beside controller programs store it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TransformNumbers {
    /// Matrix M of [`Transform`], dimensionless.
    pub matrix: [[f64; 2]; 2],
    /// Reference point (centre) [x, y] of the part, mm.
    pub centre_mm: [f64; 2],
    /// Image of the reference point on the machine [x, y], mm.
    pub image_mm: [f64; 2],
}

impl From<&Transform> for TransformNumbers {
    fn from(t: &Transform) -> Self {
        Self { matrix: t.matrix, centre_mm: t.centre_mm, image_mm: t.image_mm }
    }
}

impl TransformNumbers {
    /// Returns the transform with a covariance of 0. Refuses what [`Transform::new`] refuses.
    pub fn checked(&self) -> Result<Transform, Invalid> {
        Transform::new(self.matrix, self.centre_mm, self.image_mm, [[0.0; 6]; 6])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quarter() -> Transform {
        let covariance: [[f64; 6]; 6] =
            std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)) * 1e-4));
        Transform::new([[0.0, -1.0], [1.0, 0.0]], [1.0, 2.0], [10.0, 20.0], covariance).unwrap()
    }

    #[test]
    fn a_quarter_turn_takes_x_to_y() {
        let t = quarter();
        assert_eq!(t.point([1.0, 2.0]), [10.0, 20.0]);
        assert_eq!(t.point([2.0, 2.0]), [10.0, 21.0]);
        // Below: rounding of an angle and of a root of the order 1.
        assert!((t.angle_rad() - std::f64::consts::FRAC_PI_2).abs() < 1e-15 && t.scale() == 1.0);
        assert_eq!(t.largest_stretch(), 1.0);
        // Variance of a point: that of the image, and of the row of M times the distance.
        let e = t.standard_error_mm([4.0, 6.0]);
        assert!((e[0] - (1e-4_f64 * 26.0).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn the_inverse_goes_back_with_the_uncertainty_of_the_point() {
        let m = [[1.1, -0.2], [0.3, 0.9]];
        let t = Transform::new(m, [1.0, 2.0], [10.0, 20.0], *quarter().covariance()).unwrap();
        let back = t.inverse().unwrap();
        let p = [3.0, -4.0];
        let q = t.point(p);
        let r = back.point(q);
        // Rounding of coordinates of some 20 mm.
        assert!((r[0] - p[0]).abs() < 1e-13 && (r[1] - p[1]).abs() < 1e-13);
        // The covariance by differences: dp = -N dq at the same q.
        let [[a, b], [c, d]] = m;
        let det = a * d - b * c;
        let n = [[d / det, -b / det], [-c / det, a / det]];
        // The covariance of q is (1 + |p - centre|^2) 1e-4 on each axis, without correlation.
        let var = 1e-4 * (1.0 + 4.0 + 36.0);
        let e = back.standard_error_mm(q);
        for axis in 0..2 {
            let expected = (var * (n[axis][0].powi(2) + n[axis][1].powi(2))).sqrt();
            // Rounding of a product.
            assert!((e[axis] - expected).abs() < 1e-12, "{} {expected}", e[axis]);
        }
    }

    #[test]
    fn a_cubic_stays_a_cubic() {
        let c = [[1.0, 2.0, -0.5, 0.1], [3.0, 0.2, 0.4, -0.3]];
        let motion = Trajectory::new(vec![5.0, 7.0], vec![c], vec![false], vec![Some(3)]).unwrap();
        let motion = motion.with_rate_factor(vec![0.5]).unwrap();
        let t = Transform::new([[1.1, -0.2], [0.3, 0.9]], [1.0, 2.0], [10.0, 20.0], [[0.0; 6]; 6]);
        let t = t.unwrap();
        let moved = t.trajectory(&motion).unwrap();
        for u in [0.0, 0.7, 2.0] {
            let (found, expected) =
                (moved.segment(0).position_mm(u), t.point(motion.segment(0).position_mm(u)));
            // Rounding of coordinates of some 20 mm.
            assert!(
                (0..2).all(|a| (found[a] - expected[a]).abs() < 1e-13),
                "{found:?} {expected:?}"
            );
        }
        let s = moved.segment(0);
        assert_eq!((s.tool_on, s.dwell_index, s.rate_factor), (false, Some(3), 0.5));
        let path = ToolPath::new(vec![[0.0; 2], [2.0, 0.0]], vec![[1.0, 0.0]], vec![true], vec![4]);
        let path = t.tool_path(&path.unwrap()).unwrap();
        assert_eq!((path.dwell_point_mm()[0], path.pass_idx()[0]), (t.point([1.0, 0.0]), 4));
    }

    #[test]
    fn a_mirror_has_an_angle_and_a_scale() {
        // Turned by 30 degrees after y was turned over, twice as large.
        let (sine, cosine) = (0.5, 0.75_f64.sqrt());
        let m = [[2.0 * cosine, 2.0 * sine], [2.0 * sine, -2.0 * cosine]];
        let t = Transform::new(m, [0.0; 2], [0.0; 2], [[0.0; 6]; 6]).unwrap();
        assert!(t.mirrors() && !quarter().mirrors());
        // Rounding of degrees, and of a scale.
        assert!(
            (t.angle_rad().to_degrees() - 30.0).abs() < 1e-12 && (t.scale() - 2.0).abs() < 1e-15
        );
        let back = t.inverse().unwrap();
        let p = back.point(t.point([3.0, -4.0]));
        // Rounding of coordinates of some 10 mm.
        assert!((p[0] - 3.0).abs() < 1e-14 && (p[1] + 4.0).abs() < 1e-14, "{p:?}");
    }

    #[test]
    fn what_collapses_and_what_is_no_covariance_are_refused() {
        let said = |m, covariance| {
            Transform::new(m, [0.0; 2], [0.0; 2], covariance).unwrap_err().to_string()
        };
        assert!(said([[1.0, 1.0], [1.0, 1.0]], [[0.0; 6]; 6]).contains("the determinant 0"));
        assert!(said([[1e3, 0.0], [0.0, 1e-3]], [[0.0; 6]; 6]).contains("matrix"));
        let mut c = [[0.0; 6]; 6];
        c[2][2] = -1.0;
        assert!(said([[1.0, 0.0], [0.0, 1.0]], c).contains("covariance_mm2[2, 2]: is -1"));
    }
}
