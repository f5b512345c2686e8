//! Refinement of the mesh: nodes added where they lower the objective most.
//!
//! Between two nodes the density is linear, and the motion uses all of the acceleration at one end of the span only.
//! The more the two densities differ, the less it uses on the way. In most spans this hardly matters. The spans in
//! which it does are found near the minimum, where the dual variables z of their rows c are large:
//!
//! ```text
//! worth of halving a span = sum over its rows of z_i (c_i halved - c_i)    nm^2      (1)
//! ```
//!
//! is the first-order decrease of the objective. A span is halved if this is more than a small fraction of the
//! objective. The method goes on from densities that are also inside the rows of the halves.

use planish_types::{Limits, ToolPath};

use crate::{
    axes::Further,
    curve::Curve,
    interior_point::{Approach, Start},
    limits::{LimitRows, constant_acceleration},
    mesh::Mesh,
};

/// Worth of halving a span (the decrease of the objective), (1) of the module, above which the span is halved. It is a
/// fraction of the objective per node. Larger: fewer nodes and a larger residual. Smaller: more nodes, which take more
/// time than they gain. Chosen.
const LEAST_WORTH: f64 = 4e-3;

/// Factor by which [`LEAST_WORTH`] grows until the nodes are affordable. Larger: fewer nodes than are affordable.
/// Smaller: more meshes that are tried. Chosen.
const DEARER: f64 = 2.0;

/// Least slack of the rows of a halved span at the start, dimensionless (1 at rest). Larger: fewer spans can be
/// halved. Smaller: short first steps. Chosen.
const LEAST_SLACK: f64 = 0.02;

/// Densities that are tried in the middle of a halved span, as weights of the mean density of its ends. Weight 1: this
/// mean, with the same time as before. Weight 0: the density of a constant acceleration, with the largest slacks. More
/// weights: starts nearer to the mean; fewer: the opposite. Chosen.
const TOWARDS_MEAN: [f64; 5] = [1.0, 0.75, 0.5, 0.25, 0.0];

/// Mesh that is finer than another one, with a start for the solver.
pub struct Refined {
    pub mesh: Mesh,
    /// Densities and dual variables from which the solver begins on the finer mesh.
    pub start: Start,
    /// Node of the coarser mesh with the same two neighbours, for every node (nodes); `None` for new nodes and their
    /// neighbours.
    pub same: Vec<Option<usize>>,
}

/// Inputs of the problem that are the same for all meshes.
pub struct MeshInputs<'a> {
    pub curves: &'a [Curve],
    pub path: &'a ToolPath,
    pub limits: &'a Limits,
    pub further: Option<&'a Further<'a>>,
    /// Density of the usual size (D_0 of [`crate::limits`]), s/mm.
    pub reference_s_per_mm: f64,
    pub min_dwell_s_per_mm: f64,
}

impl MeshInputs<'_> {
    /// Returns the limits of the machine as rows (constraints) on the densities of a mesh.
    pub fn rows<'m>(&self, mesh: &'m Mesh) -> LimitRows<'m> {
        let rows = LimitRows::new(self.curves, mesh, self.limits, self.reference_s_per_mm);
        match self.further {
            None => rows,
            Some(further) => rows.with_further(self.curves, further),
        }
    }

    /// Returns the least density of every node (nodes), s/mm: by the velocity limits and by the settings.
    pub fn floors(&self, rows: &LimitRows<'_>) -> Vec<f64> {
        rows.least_density().iter().map(|d| d.max(self.min_dwell_s_per_mm)).collect()
    }

    /// Returns a finer mesh that is `affordable`, with a start from the iterate `at` of the solver on `mesh`. `None` if
    /// no span is worth halving by (1) of the module among meshes that are affordable, or if the rows of the halves
    /// allow no start.
    pub fn refined(
        &self,
        mesh: &Mesh,
        rows: &LimitRows<'_>,
        at: &Approach,
        affordable: impl Fn(&Mesh) -> bool,
    ) -> Option<Refined> {
        let worth = rows.worth_of_halving(&at.density, &at.duals[0]);
        let mut least = LEAST_WORTH * at.value / mesh.nodes as f64;
        let (mut halved, mut finer) = loop {
            let halved: Vec<bool> = worth.iter().map(|w| *w > least).collect();
            if !halved.contains(&true) {
                return None;
            }
            let finer = mesh.refined(self.curves, self.path, &halved);
            if affordable(&finer) {
                break (halved, finer);
            }
            least *= DEARER;
        };
        let towards = self.towards_mean(mesh, &finer, &halved, &at.density);
        if halved.iter().zip(&towards).any(|(halved, towards)| *halved && towards.is_none()) {
            halved = towards.iter().map(Option::is_some).collect();
            if !halved.contains(&true) {
                return None;
            }
            finer = mesh.refined(self.curves, self.path, &halved);
        }
        let before = nodes_before(mesh, &halved);
        let start = self.start(mesh, rows, &finer, &towards, &before, at);
        let mut beside_new = vec![false; mesh.nodes];
        for (span, _) in mesh.spans.iter().zip(&halved).filter(|(_, halved)| **halved) {
            span.nodes.iter().flatten().for_each(|j| beside_new[*j] = true);
        }
        let same = before.into_iter().map(|before| before.filter(|j| !beside_new[*j])).collect();
        Some(Refined { mesh: finer, start, same })
    }

    /// Returns, for every span that is to be halved, the first weight of [`TOWARDS_MEAN`] that the rows of the halves
    /// allow; `None` if there is none, and for the other spans.
    fn towards_mean(
        &self,
        mesh: &Mesh,
        finer: &Mesh,
        halved: &[bool],
        density: &[f64],
    ) -> Vec<Option<f64>> {
        let rows = self.rows(finer);
        let of_spans = rows.of_spans();
        let mut towards_mean = vec![None; halved.len()];
        for towards in TOWARDS_MEAN {
            let all: Vec<_> =
                halved.iter().map(|halved| if *halved { Some(towards) } else { None }).collect();
            let slacks = rows.slacks(&densities(mesh, &all, density));
            let mut spans = of_spans.iter();
            for (first, halved) in towards_mean.iter_mut().zip(halved) {
                let parts = spans.by_ref().take(if *halved { 2 } else { 1 });
                let slacks = parts.flat_map(|rows| &slacks[rows.clone()]);
                let least = slacks.copied().fold(f64::INFINITY, f64::min);
                if *halved && least >= LEAST_SLACK && first.is_none() {
                    *first = Some(towards);
                }
            }
        }
        towards_mean
    }

    /// Returns the start on the finer mesh. Rows and bounds that stay keep their dual variables. New ones get dual
    /// variables whose product with the slack is the mean product on the coarser mesh.
    fn start(
        &self,
        mesh: &Mesh,
        rows: &LimitRows<'_>,
        finer: &Mesh,
        towards: &[Option<f64>],
        before: &[Option<usize>],
        at: &Approach,
    ) -> Start {
        let density = densities(mesh, towards, &at.density);
        let finer_rows = self.rows(finer);
        let slacks = finer_rows.slacks(&density);
        let mut z: Vec<f64> = slacks.iter().map(|slack| at.mean_product / slack).collect();
        let (from, to) = (rows.of_spans(), finer_rows.of_spans());
        let mut of_finer = to.into_iter();
        for (from, towards) in from.into_iter().zip(towards) {
            let to = of_finer.next();
            match (towards, to) {
                (None, Some(to)) if to.len() == from.len() => {
                    z[to].copy_from_slice(&at.duals[0][from]);
                }
                // Other floors at its nodes imply other rows of further axes.
                (None, Some(_)) => {}
                _ => drop(of_finer.next()),
            }
        }
        let room = density.iter().zip(self.floors(&finer_rows)).map(|(d, lo)| d - lo);
        let y = before.iter().zip(room);
        let y = y.map(|(before, room)| before.map_or(at.mean_product / room, |j| at.duals[1][j]));
        let y = y.collect();
        Start { density, duals: Some([z, y]) }
    }
}

/// Returns the node of the coarser mesh for every node of the finer one (nodes); `None` for new nodes.
fn nodes_before(mesh: &Mesh, halved: &[bool]) -> Vec<Option<usize>> {
    let mut before = Vec::new();
    for (span, halved) in mesh.spans.iter().zip(halved) {
        if *halved {
            before.push(None);
        }
        before.extend(span.nodes[1].map(Some));
    }
    before
}

/// Returns the densities of the nodes of the finer mesh, s/mm. A new node has the mixture of the mean and the density
/// of a constant acceleration by the weight `towards` of its span; the others keep their density.
fn densities(mesh: &Mesh, towards: &[Option<f64>], density: &[f64]) -> Vec<f64> {
    let mut all = Vec::with_capacity(density.len());
    for (span, towards) in mesh.spans.iter().zip(towards) {
        let ends = span.densities(density);
        if let (Some(towards), [Some(a), Some(b)]) = (towards, ends) {
            all.push(towards * 0.5 * (a + b) + (1.0 - towards) * constant_acceleration(a, b));
        }
        all.extend(ends[1]);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        curve::{Rounding, curves},
        mesh::Span,
    };
    use planish_types::{MachineFile, MachineFileAxis};

    #[test]
    fn the_method_goes_on_inside_the_rows_and_what_stays_is_kept() {
        let axis = |name: &str, a: f64| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 80.0,
            max_acceleration_mm_per_s2: a,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x", 900.0), axis("y", 500.0)];
        let machine = MachineFile { name: "test".into(), axes, ..MachineFile::default() };
        let limits = machine.checked().unwrap();
        let points = vec![[0.0, 0.0], [6.0, 0.0], [6.0, 1.0], [0.5, 1.0], [1.5, 2.5], [6.0, 3.0]];
        let path = ToolPath::through(points, vec![true; 5], vec![0; 5]).unwrap();
        let curves = curves(&path, &Rounding { deviation_mm: 0.15, radius_mm: 1.0 }).curves;
        let mesh = Mesh::new(&curves, &path, 0.8).unwrap();
        let given = MeshInputs {
            curves: &curves,
            path: &path,
            limits: &limits,
            further: None,
            reference_s_per_mm: 0.1,
            min_dwell_s_per_mm: 0.0,
        };
        let rows = given.rows(&mesh);
        // Densities that go up and down, as far as the rows allow.
        let rough =
            |d: f64| (0..mesh.nodes).map(|j| d * (1.0 + 0.4 * (2.1 * j as f64).sin())).collect();
        let least = |d: &Vec<f64>| rows.slacks(d).into_iter().fold(1.0, f64::min);
        let levels = (1..100).map(|k| 0.01 * f64::from(k));
        let inside = |d: &Vec<f64>| least(d) > 0.05;
        let density: Vec<f64> = levels.map(rough).find(inside).expect("slow enough");
        let slack = rows.slacks(&density);
        let z: Vec<f64> =
            (0..rows.len()).map(|i| (1.0 + (i % 5) as f64) * 1e-3 / slack[i]).collect();
        let y: Vec<f64> = (0..mesh.nodes).map(|j| 1.0 + j as f64).collect();
        let at = Approach {
            density: density.clone(),
            duals: [z.clone(), y.clone()],
            value: 1.0,
            mean_product: 1e-3,
            iterations: 1,
        };
        let Refined { mesh: finer, start, same } =
            given.refined(&mesh, &rows, &at, |_| true).unwrap();
        assert!(finer.nodes > mesh.nodes && finer.nodes < 2 * mesh.nodes);
        let finer_rows = given.rows(&finer);
        let slacks = finer_rows.slacks(&start.density);
        assert!(slacks.iter().all(|c| *c >= LEAST_SLACK));
        let [finer_z, finer_y] = start.duals.unwrap();
        assert_eq!((finer_z.len(), finer_y.len()), (finer_rows.len(), finer.nodes));
        // The rows of a span that is still there have their dual variables, those of a new one the mean product.
        let (from, to) = (rows.of_spans(), finer_rows.of_spans());
        for (span, finer_rows) in finer.spans.iter().zip(to) {
            let whole =
                |s: &Span| (s.curve, s.from_mm, s.to_mm) == (span.curve, span.from_mm, span.to_mm);
            match mesh.spans.iter().position(whole) {
                Some(i) => assert_eq!(finer_z[finer_rows], z[from[i].clone()]),
                None => finer_rows.for_each(|i| assert_eq!(finer_z[i], 1e-3 / slacks[i])),
            }
        }
        // A node is where it was, with the density that it had; new ones are between their neighbours.
        let arc = |mesh: &Mesh| -> Vec<f64> {
            mesh.spans.iter().filter(|s| s.nodes[1].is_some()).map(|s| s.to_mm).collect()
        };
        let (before, after) = (arc(&mesh), arc(&finer));
        for (k, s) in after.iter().enumerate() {
            match before.iter().position(|b| b == s) {
                Some(j) => {
                    assert_eq!((start.density[k], finer_y[k]), (density[j], y[j]));
                    // Known are the columns of which neither neighbour is new.
                    let neighbours = |at: &[f64], j: usize| {
                        [j.checked_sub(1).map(|j| at[j]), at.get(j + 1).copied()]
                    };
                    let unchanged = neighbours(&before, j) == neighbours(&after, k);
                    assert_eq!(same[k], unchanged.then_some(j), "node {k}");
                }
                None => {
                    let [low, high] = [k - 1, k + 1].map(|k| start.density[k]);
                    let between = low.min(high)..=low.max(high);
                    assert!(between.contains(&start.density[k]));
                    assert_eq!(same[k], None);
                }
            }
        }
        // Nothing is affordable, or nothing is worth it.
        assert!(given.refined(&mesh, &rows, &at, |_| false).is_none());
        let worthless = Approach { value: 1e12, ..at };
        assert!(given.refined(&mesh, &rows, &worthless, |_| true).is_none());
    }
}
