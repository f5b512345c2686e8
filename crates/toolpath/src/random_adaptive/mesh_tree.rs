//! The mesh-tree path: around a random tree of triangles.
//!
//! A triangulation whose edges follow the spacing; a random spanning tree of its triangles
//! (neighbours have an edge in common); every triangle f cut into six by its centroid C, its vertices V_e
//! and the middles M_e of its edges. The small triangle (f, e, s) has the corners C, M_e and V_e
//! (s = 0) or V_e+1 (s = 1). Counter-clockwise pointers
//!
//! ```text
//! (f,e,1) -> (f,e+1,0)
//! (f,e,0) -> (g,e',1)   when e is an edge of the tree, shared with g, whose edge e' it is
//!         -> (f,e,1)    otherwise
//! ```
//!
//! make one closed cycle through all 6F small triangles: each triangle is a ring of six, and an
//! edge of the tree merges two rings. The path joins one node per small triangle,
//!
//! ```text
//! (C + w V + M) / (2 + w)
//! ```
//!
//! A step around a triangle lies in the union of two small triangles, which is convex there. A
//! step over an edge of the tree may leave it: then it goes by two more nodes, drawn towards
//! (w V + M)/(w + 1), so that it meets the edge between V and M. Small triangles are visited
//! once, so no two steps can cross.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | f, e, s | `face`, `edge`, `side` | F, 3, 2 | - |
//! | l | `edge_mm` | - | mm |

use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use spade::{DelaunayTriangulation, Point2, Triangulation};

use super::{EDGE_PER_SPACING, Loop, Point, field::Field, points::mesh_points};

/// Weight w of the vertex, dimensionless. The middle of the gap around a vertex is the point that is farthest from
/// the path: with w = 1 it is 1.01 pitches away in a uniform path, with 1.4 it is 0.9 (measured). Larger: no gain,
/// and sharper turns. Smaller: wider gaps.
const VERTEX_WEIGHT: f64 = 1.4;
/// Number of Lloyd iterations, which move the points of the mesh to the centroids of their cells. Larger: more time,
/// more even triangles. Smaller: less even triangles.
const LLOYD_ITERATIONS: usize = 20;
/// Height of a border triangle, as a fraction of its longest edge, below which it is left out. Larger: gaps at the
/// border. Smaller: needle-like triangles with short steps.
const MIN_HEIGHT: f64 = 0.1;
/// Point at which a step with two more nodes meets the edge between V and M. It is a fraction of the distance from `(w
/// V + M)/(w + 1)` to the end of the edge beyond which the straight step passes. Larger: nearer to that end. Smaller:
/// nearer to the middle.
const MEETS_AT: f64 = 0.5;

/// Returns one closed path for each part of the mesh whose triangles are connected by edges. `scale` is a factor on the
/// spacing of the field.
pub(super) fn mesh_tree(field: &Field, scale: f64, rng: &mut ChaCha8Rng) -> Vec<Loop> {
    let edge_mm = |p: Point| EDGE_PER_SPACING * scale * field.spacing_mm(p);
    let points = mesh_points(field, &edge_mm, LLOYD_ITERATIONS, rng);
    let mesh = Mesh::new(field, points);
    let tree = mesh.tree(rng);
    let mut seen = vec![false; 6 * mesh.face.len()];
    let mut loops = Vec::new();
    for start in 0..mesh.face.len() {
        if !seen[6 * start] {
            loops.push(mesh.walk(start, &tree, &mut seen));
        }
    }
    loops
}

struct Mesh {
    point: Vec<Point>,
    /// Indices of the vertices of every triangle, counter-clockwise, shape (F).
    face: Vec<[usize; 3]>,
    /// Triangle and its edge beyond the edge e from V_e to V_e+1, shape (F, 3); `None` at the border.
    beyond: Vec<[Option<(usize, usize)>; 3]>,
}

impl Mesh {
    fn new(field: &Field, point: Vec<Point>) -> Self {
        let vertices = point.iter().map(|p| Point2::new(p[0], p[1])).collect();
        let mesh = DelaunayTriangulation::<Point2<f64>>::bulk_load_stable(vertices)
            .expect("the points are finite");
        let mut face: Vec<[usize; 3]> =
            mesh.inner_faces().map(|f| f.vertices().map(|v| v.fix().index())).collect();
        face.retain(|f| {
            let [a, b, c] = f.map(|v| point[v]);
            let centroid = [0, 1].map(|x| (a[x] + b[x] + c[x]) / 3.0);
            // The island of the corners does not matter: gaps are wider than a spacing.
            field.island(centroid).is_some()
        });
        // A border that is straight or bends inwards has slivers on it: off, layer by layer.
        loop {
            let beyond = beyond(&face);
            let sliver: Vec<bool> = face
                .iter()
                .zip(&beyond)
                .map(|(face, beyond)| is_border_sliver(face.map(|v| point[v]), beyond))
                .collect();
            if !sliver.contains(&true) {
                return Self { point, face, beyond };
            }
            face = (0..face.len()).filter(|f| !sliver[*f]).map(|f| face[f]).collect();
        }
    }

    /// Returns true for the edges of triangles that belong to random depth-first spanning trees, one for every
    /// connected part, shape (F, 3).
    fn tree(&self, rng: &mut ChaCha8Rng) -> Vec<[bool; 3]> {
        let mut tree = vec![[false; 3]; self.face.len()];
        let mut seen = vec![false; self.face.len()];
        for root in 0..self.face.len() {
            if std::mem::replace(&mut seen[root], true) {
                continue;
            }
            let mut stack = vec![(root, shuffled(rng), 0)];
            while let Some((f, order, tried)) = stack.last_mut() {
                let Some(e) = order.get(*tried).copied() else {
                    stack.pop();
                    continue;
                };
                *tried += 1;
                let f = *f;
                if let Some((g, back)) = self.beyond[f][e].filter(|(g, _)| !seen[*g]) {
                    seen[g] = true;
                    tree[f][e] = true;
                    tree[g][back] = true;
                    stack.push((g, shuffled(rng), 0));
                }
            }
        }
        tree
    }

    /// Returns the closed path through the small triangles of the part that contains triangle `start`, and marks them
    /// as `seen`.
    fn walk(&self, start: usize, tree: &[[bool; 3]], seen: &mut [bool]) -> Loop {
        let first = (start, 0, 0);
        let mut small = first;
        let mut path = Loop::default();
        loop {
            let (f, e, s) = small;
            seen[6 * f + 2 * e + s] = true;
            path.visits += 1;
            path.node_mm.push(self.node(small));
            small = match self.beyond[f][e] {
                _ if s == 1 => (f, (e + 1) % 3, 0),
                Some((g, other)) if tree[f][e] => {
                    let next = (g, other, 1);
                    path.node_mm.extend(self.detour(small, next).into_iter().flatten());
                    next
                }
                _ => (f, e, 1),
            };
            if small == first {
                return path;
            }
        }
    }

    fn corners(&self, f: usize) -> [Point; 3] {
        self.face[f].map(|v| self.point[v])
    }

    /// Returns the vertex V and the middle M of the edge of a small triangle.
    fn half_edge(&self, (f, e, s): (usize, usize, usize)) -> (Point, Point) {
        let v = self.corners(f);
        let (a, b) = (v[e], v[(e + 1) % 3]);
        ([a, b][s], [0, 1].map(|x| 0.5 * (a[x] + b[x])))
    }

    fn node(&self, small: (usize, usize, usize)) -> Point {
        let [a, b, c] = self.corners(small.0);
        let (v, m) = self.half_edge(small);
        // (C + w V + M) / (2 + w)
        [0, 1].map(|x| {
            ((a[x] + b[x] + c[x]) / 3.0 + VERTEX_WEIGHT * v[x] + m[x]) / (2.0 + VERTEX_WEIGHT)
        })
    }

    /// Returns two nodes between those of the small triangles `from` and `to` if their line does not meet the shared
    /// edge; otherwise `None`.
    fn detour(&self, from: (usize, usize, usize), to: (usize, usize, usize)) -> Option<[Point; 2]> {
        let (v, m) = self.half_edge(from);
        let [a, b] = [from, to].map(|small| self.node(small));
        // The line a b meets the line V M at V + u (M - V).
        let along = minus(m, v);
        let step = minus(b, a);
        let u = cross(minus(a, v), step) / cross(along, step);
        // (w V + M)/(w + 1) = V + e (M - V). Drawn towards it by a fraction, a b meets V M at
        // e + fraction (u - e).
        let e = 1.0 / (VERTEX_WEIGHT + 1.0);
        let end = if u < e { 0.0 } else { 1.0 };
        let fraction = MEETS_AT * (end - e) / (u - e);
        let passes_by = u <= 0.0 || u >= 1.0;
        let drawn = [a, b].map(|p| {
            [0, 1].map(|x| {
                let centre = v[x] + e * along[x];
                centre + fraction * (p[x] - centre)
            })
        });
        if passes_by { Some(drawn) } else { None }
    }
}

/// Returns true if the longest edge of a triangle is on the border and its height over that edge is below
/// [`MIN_HEIGHT`] times the edge.
fn is_border_sliver(corners: [Point; 3], beyond: &[Option<(usize, usize)>; 3]) -> bool {
    let side = [0, 1, 2].map(|e| minus(corners[(e + 1) % 3], corners[e]));
    let length = side.map(|[x, y]| x.hypot(y));
    let longest = (0..3).max_by(|a, b| length[*a].total_cmp(&length[*b]));
    let e = longest.expect("there are three edges");
    let height = cross(side[0], side[1]) / length[e];
    beyond[e].is_none() && height < MIN_HEIGHT * length[e]
}

/// Returns the three edges of a triangle in random order.
fn shuffled(rng: &mut ChaCha8Rng) -> [usize; 3] {
    let mut order = [0, 1, 2];
    order.shuffle(rng);
    order
}

/// Returns for every edge of every triangle the triangle beyond it, and the number of the edge there, shape (F, 3);
/// `None` at the border.
fn beyond(face: &[[usize; 3]]) -> Vec<[Option<(usize, usize)>; 3]> {
    let mut half: Vec<_> = (0..3 * face.len())
        .map(|k| {
            let (f, e) = (k / 3, k % 3);
            let (a, b) = (face[f][e], face[f][(e + 1) % 3]);
            (a.min(b), a.max(b), f, e)
        })
        .collect();
    half.sort_unstable();
    let mut beyond = vec![[None; 3]; face.len()];
    for w in half.windows(2).filter(|w| (w[0].0, w[0].1) == (w[1].0, w[1].1)) {
        beyond[w[0].2][w[0].3] = Some((w[1].2, w[1].3));
        beyond[w[1].2][w[1].3] = Some((w[0].2, w[0].3));
    }
    beyond
}

fn minus(a: Point, b: Point) -> Point {
    [a[0] - b[0], a[1] - b[1]]
}

fn cross(a: Point, b: Point) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random_adaptive::{Construction, RandomAdaptiveSettings};
    use ndarray::Array2;
    use planish_types::{Axis, Grid, Surface};
    use rand::SeedableRng;

    fn field(valid: impl Fn(f64, f64) -> bool) -> Field {
        let axis = Axis::new(0.0, 0.5, 61).unwrap();
        let height = Array2::from_shape_fn((61, 61), |(r, c)| {
            let (x, y) = (axis.coordinate_mm(c), axis.coordinate_mm(r));
            if valid(x, y) { 1.0 + x } else { f64::NAN }
        });
        let surface = Surface::new(Grid { x: axis, y: axis }, height).unwrap();
        let settings = RandomAdaptiveSettings {
            pitch_mm: 1.0,
            overscan_mm: 1.0,
            step_mm: None,
            contrast: 1.0,
            construction: Construction::MeshTree,
            rounding_passes: 0,
            seed: 0,
        };
        Field::new(&surface, &settings).unwrap()
    }

    /// Returns true if Euler's formula holds: F = 2 V - 2 + 2 holes - B for one part with F triangles, V vertices and B
    /// edges on its border.
    fn euler(mesh: &Mesh, holes: usize) -> bool {
        let border = mesh.beyond.iter().flatten().filter(|b| b.is_none()).count();
        let mut used: Vec<usize> = mesh.face.iter().flatten().copied().collect();
        used.sort_unstable();
        used.dedup();
        mesh.face.len() + 2 + border == 2 * used.len() + 2 * holes
    }

    #[test]
    fn one_cycle_visits_every_small_triangle_once() {
        let ring = |x: f64, y: f64| (4.0..=15.0).contains(&(x - 15.0).hypot(y - 15.0));
        for (field, holes) in [(field(|_, _| true), 0), (field(ring), 1)] {
            for seed in 0..5 {
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let edge = |p: Point| EDGE_PER_SPACING * field.spacing_mm(p);
                let mesh = Mesh::new(&field, mesh_points(&field, &edge, 20, &mut rng));
                assert!(euler(&mesh, holes), "{holes}");
                let tree = mesh.tree(&mut rng);
                let joined = tree.iter().flatten().filter(|t| **t).count();
                assert_eq!(joined, 2 * (mesh.face.len() - 1));
                let mut seen = vec![false; 6 * mesh.face.len()];
                let path = mesh.walk(0, &tree, &mut seen);
                // All are seen in 6F visits: each once.
                assert!(seen.iter().all(|s| *s));
                assert_eq!(path.visits, 6 * mesh.face.len());
                assert!(path.node_mm.len() >= path.visits);
            }
        }
    }

    #[test]
    fn a_step_over_a_flat_pair_of_triangles_meets_their_edge() {
        // Neighbours that lean far to one side.
        let point = vec![[0.0, 0.0], [1.0, 0.0], [4.0, 1.0], [4.5, -1.0]];
        let mesh = Mesh {
            point,
            face: vec![[0, 1, 2], [1, 0, 3]],
            beyond: vec![[Some((1, 0)), None, None], [Some((0, 0)), None, None]],
        };
        let tree = vec![[true, false, false]; 2];
        let path = mesh.walk(0, &tree, &mut [false; 12]);
        assert_eq!(path.visits, 12);
        assert!(path.node_mm.len() > 12, "no detour");
        assert!(super::super::crossing::crossings(std::slice::from_ref(&path.node_mm)).is_empty());
        // Steps from one side of y = 0 to the other, where they meet it: on the edge 0 .. 1.
        let ends = path.node_mm.iter().zip(path.node_mm.iter().cycle().skip(1));
        let over: Vec<f64> = ends
            .filter(|(a, b)| a[1] * b[1] < 0.0)
            .map(|(a, b)| a[0] - a[1] * (b[0] - a[0]) / (b[1] - a[1]))
            .collect();
        assert_eq!(over.len(), 2);
        assert!(over.iter().all(|x| (0.0..=1.0).contains(x)), "{over:?}");
    }
}
