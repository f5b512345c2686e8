//! Coordinates along the surface of a part (its development into a plane), and lengths on the surface.
//!
//! ```text
//! ds^2 = dx^2 + dy^2 + (f_x dx + f_y dy)^2                                                              (1)
//! cylinder       u = arc length across the lines of the cylinder, v = distance along them               (2)
//! other forms    (u, v) = s (w . t1, w . t2) / |w|,   s = arc length of the form over the straight line from the middle
//!                         o of the part, w = the direction in which that line leaves o, t1, t2 = tangents at o  (3)
//! ```
//!
//! (2) is exact: the cylinder is unrolled. A part with curvature in both directions cannot be unrolled. (3) keeps all
//! lengths along the lines through o, and shortens or lengthens those around it; on a sphere by sin(b) / b at the angle
//! b from o. [`Development::stretches`] returns this factor at a point. (2) and (3) are aligned with x and y of the
//! part at o, where (u, v) = (x, y).

use planish_types::Invalid;

use crate::{Form, FormPoint};

/// Nodes and weights of the Gauss-Legendre rule of five points on [0, 1].
const GAUSS: [(f64, f64); 5] = [
    (0.046_910_077_030_668_0, 0.118_463_442_528_094_5),
    (0.230_765_344_947_158_45, 0.239_314_335_249_683_2),
    (0.5, 0.284_444_444_444_444_4),
    (0.769_234_655_052_841_5, 0.239_314_335_249_683_2),
    (0.953_089_922_969_332, 0.118_463_442_528_094_5),
];

/// Number of pieces into which a quadrature divides the size of a part. Larger: more time. Smaller: steep forms lose
/// digits. Measured: with five points each, arcs of 50 degrees of a cylinder keep 1e-10 mm.
const PIECES: f64 = 16.0;

/// Step of the difference quotients by u and v that give the stretches, mm. Larger: curvature counts. Smaller: rounding
/// does.
const DIFFERENCE_MM: f64 = 1e-3;

/// Coordinates (u, v) along the surface of a form, in mm.
#[derive(Debug)]
pub struct Development<'a> {
    form: &'a Form,
    origin_mm: [f64; 2],
    /// Length of a piece of a quadrature, mm.
    piece_mm: f64,
    /// Unit tangents of the form at the origin, t1 and t2 of (3) in the module.
    tangents: [[f64; 3]; 2],
    gradient: [f64; 2],
}

impl<'a> Development<'a> {
    /// Returns the coordinates along a form about the point `origin_mm` [x, y] of the part, mm; `size_mm` is the size
    /// of the part. Refuses a form that does not exist at this point.
    pub fn new(form: &'a Form, origin_mm: [f64; 2], size_mm: f64) -> Result<Self, Invalid> {
        let Some(place) = form.point(origin_mm) else {
            let [x, y] = origin_mm;
            let problem = format!("does not exist in the middle of the part, at ({x}, {y}) mm");
            let remedy = "give a form that does, such as a formula in the place of a map";
            return Err(Invalid::whole("form", problem, remedy));
        };
        // A part of one pixel has no size.
        let piece_mm = if size_mm > 0.0 { size_mm / PIECES } else { 1.0 };
        let [p, q] = place.gradient();
        // t1 is x projected onto the tangent plane, t2 is perpendicular to it there.
        let n = place.normal();
        let length = (1.0 + p * p).sqrt();
        let t1 = [1.0 / length, 0.0, p / length];
        let t2 =
            [n[1] * t1[2] - n[2] * t1[1], n[2] * t1[0] - n[0] * t1[2], n[0] * t1[1] - n[1] * t1[0]];
        Ok(Self { form, origin_mm, piece_mm, tangents: [t1, t2], gradient: [p, q] })
    }

    /// Returns the coordinates (u, v) of the point `p` [x, y] of the part, mm. Beyond its edge the form continues with
    /// its last slope.
    pub fn along(&self, p: [f64; 2]) -> [f64; 2] {
        let d = [0, 1].map(|k| p[k] - self.origin_mm[k]);
        if let Some(direction) = self.form.cylinder_direction() {
            let [along, across] = turned(direction, d);
            let arc = self.arc_mm(direction, along.abs(), along.signum());
            return self.back(direction, [arc.copysign(along), across]);
        }
        let rho = d[0].hypot(d[1]);
        if rho == 0.0 {
            return p;
        }
        let direction = d.map(|v| v / rho);
        let arc = self.arc_mm(direction, rho, 1.0);
        let slope = direction[0] * self.gradient[0] + direction[1] * self.gradient[1];
        let w = [direction[0], direction[1], slope];
        let [a, b] = self.tangents.map(|t| (0..3).map(|k| w[k] * t[k]).sum::<f64>());
        let length = a.hypot(b);
        [self.origin_mm[0] + arc * a / length, self.origin_mm[1] + arc * b / length]
    }

    /// Returns the point [x, y] of the part with the coordinates (u, v), mm: the inverse of [`Self::along`].
    pub fn projected(&self, uv: [f64; 2]) -> [f64; 2] {
        let d = [0, 1].map(|k| uv[k] - self.origin_mm[k]);
        if let Some(direction) = self.form.cylinder_direction() {
            let [arc, across] = turned(direction, d);
            let rho = self.distance_mm(direction, arc.abs(), arc.signum());
            return self.back(direction, [rho.copysign(arc), across]);
        }
        let arc = d[0].hypot(d[1]);
        if arc == 0.0 {
            return uv;
        }
        // a t1 + b t2 is the direction in space; its projection is that of the line.
        let [a, b] = d.map(|v| v / arc);
        let [t1, t2] = &self.tangents;
        let [x, y] = [0, 1].map(|k| a * t1[k] + b * t2[k]);
        let length = x.hypot(y);
        let direction = [x / length, y / length];
        let rho = self.distance_mm(direction, arc, 1.0);
        [0, 1].map(|k| self.origin_mm[k] + rho * direction[k])
    }

    fn back(&self, [cosine, sine]: [f64; 2], [along, across]: [f64; 2]) -> [f64; 2] {
        [
            self.origin_mm[0] + along * cosine - across * sine,
            self.origin_mm[1] + along * sine + across * cosine,
        ]
    }

    /// Returns the ratio of arc length to length in the plane, sqrt(1 + f'^2), at the distance `rho` (mm) from the
    /// origin. The line runs along `sign` times `direction`. Beyond the form it is the ratio at the last point of the
    /// form, which `last` keeps.
    fn factor(&self, direction: [f64; 2], rho: f64, sign: f64, last: &mut f64) -> f64 {
        let p = [0, 1].map(|k| self.origin_mm[k] + sign * rho * direction[k]);
        if let Some(place) = self.form.point(p) {
            let [fx, fy] = place.gradient();
            *last = (direction[0] * fx + direction[1] * fy).hypot(1.0);
        }
        *last
    }

    /// Returns the arc length of the form over the straight line of the length `rho` from the origin, mm, along `sign`
    /// times `direction`.
    fn arc_mm(&self, direction: [f64; 2], rho: f64, sign: f64) -> f64 {
        let mut last = 1.0;
        let mut sum = 0.0;
        let pieces = (rho / self.piece_mm) as usize;
        for i in 0..pieces {
            sum +=
                self.piece(direction, (i as f64 * self.piece_mm, self.piece_mm), sign, &mut last);
        }
        let start = pieces as f64 * self.piece_mm;
        sum + self.piece(direction, (start, rho - start), sign, &mut last)
    }

    /// Returns the arc length of the form over the piece of a line from the distance `start` to `start + h`, mm.
    fn piece(&self, direction: [f64; 2], (start, h): (f64, f64), sign: f64, last: &mut f64) -> f64 {
        let mut sum = 0.0;
        for (node, weight) in GAUSS {
            sum += weight * self.factor(direction, start + node * h, sign, last);
        }
        h * sum
    }

    /// Returns the length of the straight line from the origin over which the arc of the form has the length `arc`, mm:
    /// the inverse of [`Self::arc_mm`].
    fn distance_mm(&self, direction: [f64; 2], arc: f64, sign: f64) -> f64 {
        let mut last = 1.0;
        let mut sum = 0.0;
        let mut start = 0.0;
        // An arc is at least as long as its line.
        loop {
            let before = last;
            let next = sum + self.piece(direction, (start, self.piece_mm), sign, &mut last);
            if next >= arc || start > arc {
                last = before;
                break;
            }
            sum = next;
            start += self.piece_mm;
        }
        // Newton's method in the last piece, by bisection where it would leave it.
        let mut low = 0.0;
        let mut high = self.piece_mm;
        let mut h = (arc - sum).min(high);
        for _ in 0..60 {
            let mut last_factor = last;
            let excess = sum + self.piece(direction, (start, h), sign, &mut last_factor) - arc;
            if excess > 0.0 {
                high = h
            } else {
                low = h
            }
            let next = h - excess / self.factor(direction, start + h, sign, &mut last_factor);
            let next = if next > low && next < high { next } else { 0.5 * (low + high) };
            let step = (next - h).abs();
            h = next;
            if step <= 1e-14 * arc {
                break;
            }
        }
        start + h
    }

    /// Returns the smallest and the largest ratio of a length on the surface to the same length in (u, v), at the
    /// coordinates `uv`, mm. `None` where the form does not exist. Both are 1 where the surface is unrolled exactly.
    pub fn stretches(&self, uv: [f64; 2]) -> Option<[f64; 2]> {
        let [p, q] = self.form.point(self.projected(uv))?.gradient();
        // Vectors in space for a step along u and along v, and the eigenvalues of their products.
        let [a, b] = [0, 1].map(|k| {
            let [x, y] = self.projected_by_coordinate(uv, k);
            [x, y, p * x + q * y]
        });
        let aa = dot(&a, &a);
        let ab = dot(&a, &b);
        let bb = dot(&b, &b);
        let mean = 0.5 * (aa + bb);
        let half = (0.25 * (aa - bb).powi(2) + ab * ab).sqrt();
        Some([(mean - half).max(0.0).sqrt(), (mean + half).sqrt()])
    }

    /// Returns the derivative of the point [x, y] by the coordinate u (`k` = 0) or v (1), by a central difference.
    fn projected_by_coordinate(&self, uv: [f64; 2], k: usize) -> [f64; 2] {
        let h = DIFFERENCE_MM;
        let mut ends = [uv; 2];
        ends[0][k] -= h;
        ends[1][k] += h;
        let [a, b] = ends.map(|end| self.projected(end));
        [0, 1].map(|i| (b[i] - a[i]) / (2.0 * h))
    }
}

fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

/// Returns the components of the vector [x, y] along and across a direction, which is given by its cosine and sine.
fn turned([cosine, sine]: [f64; 2], [x, y]: [f64; 2]) -> [f64; 2] {
    [x * cosine + y * sine, y * cosine - x * sine]
}

impl Form {
    /// Returns the point of the form over the point `p` [x, y] of the part, mm. Where the form does not exist there, it
    /// takes the nearest valid pixel of a map. For other forms it takes the last point on the straight line from
    /// `inside` to `p`.
    pub fn nearest(&self, p: [f64; 2], inside: [f64; 2]) -> Option<FormPoint> {
        if let Some(point) = self.point(p) {
            return Some(point);
        }
        if let Some(map) = self.map() {
            return self.point(map.nearest_mm(p));
        }
        let mut best = self.point(inside)?;
        let mut low = 0.0;
        let mut high = 1.0;
        // 40 halvings of 100 mm leave 1e-10 mm.
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            match self.point([0, 1].map(|k| inside[k] + middle * (p[k] - inside[k]))) {
                Some(point) => {
                    best = point;
                    low = middle;
                }
                None => high = middle,
            }
        }
        Some(best)
    }

    /// Returns the length on the surface over the straight line from `a` to `b` [x, y], mm, by (1) of the module and
    /// five points. `None` if the form does not exist at one of them.
    pub fn length_mm(&self, a: [f64; 2], b: [f64; 2]) -> Option<f64> {
        let d = [b[0] - a[0], b[1] - a[1]];
        let mut sum = 0.0;
        for (node, weight) in GAUSS {
            let [fx, fy] = self.point([0, 1].map(|k| a[k] + node * d[k]))?.gradient();
            sum += weight * d[0].hypot(d[1]).hypot(fx * d[0] + fy * d[1]);
        }
        Some(sum)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FormFile;

    fn form(json: &str) -> Form {
        let file: FormFile = serde_json::from_str(json).unwrap();
        Form::new(&file, None).unwrap()
    }

    #[test]
    fn a_cylinder_is_unrolled() {
        let cylinder = form(
            r#"{"kind": "cylinder", "radius_mm": 60, "rotation_deg": 25, "vertex_mm": [2, 3]}"#,
        );
        let on = Development::new(&cylinder, [2.0, 3.0], 80.0).unwrap();
        let (s, c) = 25_f64.to_radians().sin_cos();
        for (x, y) in [(30.0_f64, 8.0), (-45.0, -2.0), (0.0, 5.0)] {
            let p = [2.0 + x * c - y * s, 3.0 + x * s + y * c];
            let uv = on.along(p);
            let arc = 60.0 * (x / 60.0).asin();
            let want = [2.0 + arc * c - y * s, 3.0 + arc * s + y * c];
            assert!((0..2).all(|k| (uv[k] - want[k]).abs() < 1e-10), "{uv:?} {want:?}");
            let back = on.projected(uv);
            assert!((0..2).all(|k| (back[k] - p[k]).abs() < 1e-10), "{back:?} {p:?}");
            // Steps of 1e-3 mm carry rounding of 1e-14 / 1e-3.
            let [low, high] = on.stretches(uv).unwrap();
            assert!((low - 1.0).abs() < 1e-7 && (high - 1.0).abs() < 1e-7, "{low} {high}");
        }
    }

    #[test]
    fn on_a_sphere_the_lines_through_the_middle_keep_their_lengths() {
        let sphere = Form::sphere(100.0, [0.0; 2]).unwrap();
        let on = Development::new(&sphere, [0.0; 2], 100.0).unwrap();
        for (rho, azimuth) in [(50.0_f64, 0.3_f64), (20.0, -2.0), (60.0, 1.6)] {
            let p = [rho * azimuth.cos(), rho * azimuth.sin()];
            let angle = (rho / 100.0).asin();
            let uv = on.along(p);
            // Quadratures keep 1e-10 mm (PIECES).
            assert!((uv[0].hypot(uv[1]) - 100.0 * angle).abs() < 1e-9);
            // Rounding of an angle of the order 1.
            assert!((uv[1].atan2(uv[0]) - azimuth).abs() < 1e-12);
            let back = on.projected(uv);
            // Quadratures keep 1e-10 mm.
            assert!((0..2).all(|k| (back[k] - p[k]).abs() < 1e-9));
            let [low, high] = on.stretches(uv).unwrap();
            // Around the middle sin(b) / b; the difference over 1e-3 mm is exact to 1e-7.
            assert!(
                (low - angle.sin() / angle).abs() < 1e-6 && (high - 1.0).abs() < 1e-6,
                "{low} {high}"
            );
        }
    }

    #[test]
    fn a_tilted_sphere_is_the_same_sphere() {
        // Away from the vertex the tangent plane is tilted: in the middle of the section lengths are kept all the same.
        // The lines through it are small circles; their curvature in the surface, 0.46 / 200 per mm, turns them.
        let sphere = form(r#"{"kind": "sphere", "radius_mm": 200, "off_axis_mm": [80, 30]}"#);
        let on = Development::new(&sphere, [0.0; 2], 40.0).unwrap();
        for uv in [[1e-6, 1e-6], [3.0, 1.0], [-5.0, 4.0]] {
            let [low, high] = on.stretches(uv).unwrap();
            // 0.46 / 200 times 6.4 mm = 0.015.
            let most = 1e-6 + 0.0023 * uv[0].hypot(uv[1]);
            assert!((low - 1.0).abs() < most && (high - 1.0).abs() < most, "{uv:?}: {low} {high}");
        }
        let d = on.along([6.0, -8.0]);
        let length = sphere.length_mm([0.0; 2], [6.0, -8.0]).unwrap();
        // Quadratures keep 1e-10 mm.
        assert!((d[0].hypot(d[1]) - length).abs() < 1e-9);
    }

    #[test]
    fn beyond_a_form_its_last_slope_continues() {
        let sphere = Form::sphere(50.0, [0.0; 2]).unwrap();
        let on = Development::new(&sphere, [0.0; 2], 60.0).unwrap();
        for p in [[60.0, 0.0], [30.0, 45.0]] {
            let back = on.projected(on.along(p));
            // Quadratures keep 1e-10 mm; there and back.
            assert!((0..2).all(|k| (back[k] - p[k]).abs() < 1e-9), "{back:?} {p:?}");
        }
        assert!(sphere.nearest([60.0, 0.0], [0.0; 2]).unwrap().slope_deg() > 89.0);
        assert!(sphere.length_mm([0.0; 2], [60.0, 0.0]).is_none());
    }
}
