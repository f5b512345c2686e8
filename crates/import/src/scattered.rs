//! Interpolation of scattered points to the heights of a uniform grid.
//!
//! The points are the corners of Delaunay triangles. A pixel in a triangle gets the height of the plane through its three
//! corners, so a plane comes back to rounding and a curvature c in a triangle of longest side d is missed by at most c d^2 / 6.
//! Pixels lie at whole multiples of the pitch. A pixel outside of all triangles is invalid, and so is one in a triangle
//! with a side longer than [`LONGEST_SIDE`] median sides: a hole in the data is not bridged.

use ndarray::Array2;
use planish_types::{Invalid, budget};
use spade::{
    DelaunayTriangulation, HasPosition, Point2, PositionInTriangulation, Triangulation as _,
    handles::FixedVertexHandle,
};

use crate::budget::check_size;

/// Longest side of a triangle that is used, in median sides of all triangles. Larger: wider holes are bridged. Smaller:
/// points whose density varies leave holes. Chosen for profiles whose points are five times as dense along them as
/// across.
const LONGEST_SIDE: f64 = 3.0;

/// Memory of a point in the triangulation, bytes. Larger: refuses large sets of points that would fit. Smaller: a set
/// can exceed the memory. Derived: a vertex, six half edges, two faces, and the lists that order them.
const BYTES_PER_CORNER: usize = 400;

struct Corner {
    place: Point2<f64>,
    z: f64,
}

impl HasPosition for Corner {
    type Scalar = f64;

    fn position(&self) -> Point2<f64> {
        self.place
    }
}

/// Heights on a uniform grid, with the coordinates of the grid.
pub(crate) struct Gridded {
    /// Heights (rows, columns) in the unit of the points; NaN marks invalid pixels.
    pub values: Array2<f64>,
    /// Coordinates of the columns (`x_mm`) and of the rows (`y_mm`), mm.
    pub x_mm: Vec<f64>,
    pub y_mm: Vec<f64>,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Returns the distance of two points, mm.
fn length(a: Point2<f64>, b: Point2<f64>) -> f64 {
    (a.x - b.x).hypot(a.y - b.y)
}

/// Returns the height at `point`, or NaN outside of all triangles and on one with a side longer than `longest` (mm). It
/// also returns a corner near `point`, which is the `hint` for the next search. A point on a corner has its height.
fn interpolated(
    mesh: &DelaunayTriangulation<Corner>,
    point: Point2<f64>,
    hint: Option<FixedVertexHandle>,
    longest: f64,
) -> (f64, Option<FixedVertexHandle>) {
    let place = match hint {
        Some(hint) => mesh.locate_with_hint(point, hint),
        None => mesh.locate(point),
    };
    match place {
        PositionInTriangulation::OnVertex(v) => (mesh.vertex(v).data().z, Some(v)),
        PositionInTriangulation::OnEdge(e) => {
            let [a, b] = mesh.directed_edge(e).vertices();
            let [p, q] = [a.position(), b.position()];
            let side = length(p, q);
            if side > longest {
                return (f64::NAN, Some(a.fix()));
            }
            let t = length(p, point) / side;
            (a.data().z + t * (b.data().z - a.data().z), Some(a.fix()))
        }
        PositionInTriangulation::OnFace(f) => {
            let [a, b, c] = mesh.face(f).vertices();
            let [p, q, s] = [a.position(), b.position(), c.position()];
            if ![length(p, q), length(q, s), length(s, p)].iter().all(|l| *l <= longest) {
                return (f64::NAN, Some(a.fix()));
            }
            // z = za + u (zb - za) + v (zc - za) with point - p = u (q - p) + v (s - p)
            let [d, e, w] = [q, s, point].map(|other| [other.x - p.x, other.y - p.y]);
            let area = d[0] * e[1] - d[1] * e[0];
            let u = (w[0] * e[1] - w[1] * e[0]) / area;
            let v = (d[0] * w[1] - d[1] * w[0]) / area;
            let z = a.data().z;
            (z + u * (b.data().z - z) + v * (c.data().z - z), Some(a.fix()))
        }
        PositionInTriangulation::OutsideOfConvexHull(_)
        | PositionInTriangulation::NoTriangulation => (f64::NAN, hint),
    }
}

/// Interpolates `points` (x and y in mm, height) to a grid of the pitch `pixel_mm` [x, y], mm. Points whose height is
/// NaN are left out. Refuses a pitch that is not positive, fewer than three points or points on one line, two heights
/// at one position, and grids or points that do not fit into the memory.
pub(crate) fn grid(points: &[[f64; 3]], pixel_mm: [f64; 2]) -> Result<Gridded, Invalid> {
    if let Some(p) = pixel_mm.into_iter().find(|p| !(p.is_finite() && *p > 0.0)) {
        return Err(Invalid::whole("grid_mm", format!("is {p}"), "a pitch is positive"));
    }
    let valid: Vec<&[f64; 3]> = points.iter().filter(|p| !p[2].is_nan()).collect();
    let [(x0, columns), (y0, rows)] = [0, 1].map(|k| {
        let low = valid.iter().map(|p| p[k]).fold(f64::INFINITY, f64::min);
        let high = valid.iter().map(|p| p[k]).fold(f64::NEG_INFINITY, f64::max);
        // A point that lies on a pixel but for rounding is on it.
        let first = (low / pixel_mm[k] - 1e-6).ceil();
        let last = (high / pixel_mm[k] + 1e-6).floor();
        // A float to an integer saturates; the size is checked next.
        (first, if last >= first { (last - first + 1.0) as usize } else { 0 })
    });
    check_size("grid of the points", rows, columns)?;
    budget::affordable("points", valid.len() as f64, BYTES_PER_CORNER, "leave some out")?;

    let mut sorted = valid.clone();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    if let Some(w) = sorted.windows(2).find(|w| w[0][..2] == w[1][..2] && w[0][2] != w[1][2]) {
        let problem = format!("has two heights at x {}, y {} mm", w[0][0], w[0][1]);
        return Err(Invalid::whole("XYZ file", problem, "give every point once"));
    }
    let corners = valid.iter().map(|p| Corner { place: tidy([p[0], p[1]]), z: p[2] });
    let mesh = DelaunayTriangulation::<Corner>::bulk_load(corners.collect()).map_err(|e| {
        let remedy = "correct the coordinates or their unit";
        Invalid::whole("XYZ file", format!("has points that cannot be triangulated ({e})"), remedy)
    })?;
    let mut sides: Vec<f64> =
        mesh.undirected_edges().map(|edge| edge.positions()).map(|[a, b]| length(a, b)).collect();
    if mesh.num_inner_faces() == 0 {
        let problem = format!("has {} points on one line or fewer", valid.len());
        return Err(Invalid::whole("XYZ file", problem, "give points of an area"));
    }
    let middle = sides.len() / 2;
    let median = *sides.select_nth_unstable_by(middle, f64::total_cmp).1;
    let longest = LONGEST_SIDE * median;

    let x_mm: Vec<f64> = (0..columns).map(|i| (x0 + i as f64) * pixel_mm[0]).collect();
    let y_mm: Vec<f64> = (0..rows).map(|i| (y0 + i as f64) * pixel_mm[1]).collect();
    let mut values = Array2::from_elem((rows, columns), f64::NAN);
    let mut hint = None;
    for ((r, c), value) in values.indexed_iter_mut() {
        (*value, hint) = interpolated(&mesh, tidy([x_mm[c], y_mm[r]]), hint, longest);
    }
    let invalid = values.iter().filter(|v| v.is_nan()).count();
    let mut warnings = vec![format!(
        "the heights are interpolated: linear in Delaunay triangles of {} points with sides up to {longest:.4} mm; {invalid} \
         of {} pixels lie in none and are invalid",
        valid.len(),
        values.len()
    )];
    if pixel_mm.iter().any(|p| *p > 1.5 * median) {
        warnings.push(format!(
            "the pitch {pixel_mm:?} mm is coarser than the points, whose median distance is {median:.4} mm: not every point has \
             an effect"
        ));
    }
    Ok(Gridded { values, x_mm, y_mm, warnings })
}

/// Returns a point; coordinates of a magnitude below 1e-30 mm become 0, because the triangulation refuses them.
fn tidy(place: [f64; 2]) -> Point2<f64> {
    let [x, y] = place.map(|v| if v.abs() < 1e-30 { 0.0 } else { v });
    Point2::new(x, y)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rings of 24 points, 1 mm apart, with the heights of a function.
    fn rings(z: impl Fn(f64, f64) -> f64, rings: std::ops::Range<usize>) -> Vec<[f64; 3]> {
        let ring = |k: usize| {
            (0..24).map(move |i| (k as f64, f64::from(i) / 24.0 * std::f64::consts::TAU))
        };
        rings
            .flat_map(ring)
            .map(|(r, a)| {
                let (x, y) = (r * a.cos(), r * a.sin());
                [x, y, z(x, y)]
            })
            .collect()
    }

    #[test]
    fn a_plane_comes_back_and_a_hole_stays() {
        let plane = |x: f64, y: f64| 5.0 + 2.0 * x - 3.0 * y;
        let made = grid(&rings(plane, 1..7), [0.5, 0.25]).unwrap();
        assert_eq!((made.x_mm[0], made.y_mm[0]), (-6.0, -6.0));
        for ((r, c), v) in made.values.indexed_iter() {
            let (x, y) = (made.x_mm[c], made.y_mm[r]);
            // Within the ring of 6 mm, whose chords are 0.05 mm inside of it.
            assert!(x.hypot(y) > 5.9 || !v.is_nan(), "{x} {y}");
            // Rounding of heights up to 40 nm in triangles of 0.3 mm.
            assert!(v.is_nan() || (v - plane(x, y)).abs() < 1e-9, "{x} {y} {v}");
        }
        // Without the rings to 4 mm the hole is 8 mm wide, its triangles have sides of several mm; the median is below 1.3 mm.
        let made = grid(&rings(plane, 4..7), [0.5, 0.5]).unwrap();
        assert!(made.values[[12, 12]].is_nan() && !made.values[[12, 2]].is_nan());
        assert!(made.warnings[0].contains("of 72 points"), "{:?}", made.warnings);
    }

    #[test]
    fn what_cannot_be_gridded_is_refused() {
        let said = |points: &[[f64; 3]], pitch: f64| match grid(points, [pitch; 2]) {
            Ok(_) => panic!("{points:?} has a grid"),
            Err(error) => error.to_string(),
        };
        let line: Vec<[f64; 3]> = (0..9).map(|i| [f64::from(i), f64::from(i), 1.0]).collect();
        assert!(said(&line, 1.0).contains("on one line"));
        let mut twice = rings(|_, _| 1.0, 1..4);
        twice.push([twice[3][0], twice[3][1], 2.0]);
        assert!(said(&twice, 0.5).contains("has two heights at"));
        assert!(said(&twice, 1e-6).contains("at most"));
        assert!(said(&twice, 0.0).contains("is 0"));
        assert!(said(&[], 1.0).contains("0 rows"));
        let large = [[1e200, 0.0, 1.0], [0.0, 1e200, 1.0], [1.0, 1.0, 1.0]];
        assert!(said(&large, 1e199).contains("cannot be triangulated"));
    }
}
