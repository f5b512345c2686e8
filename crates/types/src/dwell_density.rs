//! Dwell-time density along a path, the inverse of the feedrate: the content of an artifact of the kind
//! `dwell_density`.

use crate::{Invalid, grid::is_plausible_mm};

/// Largest difference between arc lengths and the distances of their points, mm. Larger:
/// inconsistent artifacts pass. Smaller: the rounding of a script that wrote the artifact is
/// refused.
const SAME_LENGTH_MM: f64 = 1e-6;

/// Largest relative difference between the density of a corner and those of its two neighbours.
/// Larger: a blend has a step in its feedrate. Smaller: rounding is refused.
const SAME_DENSITY: f64 = 1e-9;

/// Dwell-time density at nodes along a path.
///
/// Straight lines join the nodes of one pass. A node marked as a corner is the control point of a
/// blend between its two neighbours: a parabola with constant acceleration, at the density that the
/// three nodes share. The link from one pass to the next is not part of the path.
#[derive(Clone, Debug, PartialEq)]
pub struct DwellDensity {
    nodes: DensityNodes,
}

/// The m nodes of a [`DwellDensity`], not checked yet.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DensityNodes {
    /// Length along the path (m), mm; ascending within a pass.
    pub arc_length_mm: Vec<f64>,
    /// Dwell-time density (m), s/mm; > 0, the inverse of the feedrate.
    pub dwell_density_s_per_mm: Vec<f64>,
    /// Position of the nodes [x, y] (m), mm.
    pub point_mm: Vec<[f64; 2]>,
    /// Index of the pass to which a node belongs (m), counted from 0.
    pub pass_idx: Vec<i64>,
    /// True if the node is the control point of a blend (m).
    pub corner: Vec<bool>,
}

impl DwellDensity {
    /// Returns the density at m nodes. Refuses arrays of other lengths, densities that are not positive, and arc
    /// lengths that do not ascend or differ from the distances of the points. Refuses a corner that is not midway
    /// between two nodes of its pass and density.
    pub fn new(nodes: DensityNodes) -> Result<Self, Invalid> {
        let DensityNodes { arc_length_mm, dwell_density_s_per_mm, point_mm, pass_idx, corner } =
            &nodes;
        let m = arc_length_mm.len();
        if m < 2 {
            let problem = format!("has {m} nodes");
            return Err(Invalid::whole(
                "arc_length_mm",
                problem,
                "a dwell-time density has at least two nodes",
            ));
        }
        for (name, len) in [
            ("dwell_density_s_per_mm", dwell_density_s_per_mm.len()),
            ("point_mm", point_mm.len()),
            ("pass_idx", pass_idx.len()),
            ("corner", corner.len()),
        ] {
            if len != m {
                let problem = format!("has {len} elements for {m} nodes");
                return Err(Invalid::whole(name, problem, "give one per node"));
            }
        }
        let coordinates = "give finite coordinates in mm, within 1e7 mm of the origin";
        if let Some(i) = point_mm.iter().position(|p| p.iter().any(|c| !is_plausible_mm(*c))) {
            return Err(Invalid::at_index(
                "point_mm",
                i,
                format!("is {:?}", point_mm[i]),
                coordinates,
            ));
        }
        if let Some(i) = arc_length_mm.iter().position(|s| !is_plausible_mm(*s)) {
            let problem = format!("is {}", arc_length_mm[i]);
            return Err(Invalid::at_index("arc_length_mm", i, problem, coordinates));
        }
        if let Some(i) = dwell_density_s_per_mm.iter().position(|t| !(t.is_finite() && *t > 0.0)) {
            let problem = format!("is {} s/mm", dwell_density_s_per_mm[i]);
            let remedy = "a density is positive: the inverse of the feedrate";
            return Err(Invalid::at_index("dwell_density_s_per_mm", i, problem, remedy));
        }
        for i in 1..m {
            nodes.check_step(i)?;
        }
        for i in 0..m {
            nodes.check_corner(i)?;
        }
        Ok(Self { nodes })
    }

    /// Returns the number of nodes m.
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.nodes.arc_length_mm.len()
    }

    /// Returns the lengths along the path (m), mm.
    pub fn arc_length_mm(&self) -> &[f64] {
        &self.nodes.arc_length_mm
    }

    /// Returns the dwell-time densities at the nodes (m), s/mm.
    pub fn dwell_density_s_per_mm(&self) -> &[f64] {
        &self.nodes.dwell_density_s_per_mm
    }

    /// Returns the points [x, y] (m), mm.
    pub fn point_mm(&self) -> &[[f64; 2]] {
        &self.nodes.point_mm
    }

    /// Returns the pass of each node (m).
    pub fn pass_idx(&self) -> &[i64] {
        &self.nodes.pass_idx
    }

    /// Returns the corner flags (m): true if the node is the control point of a blend.
    pub fn corner(&self) -> &[bool] {
        &self.nodes.corner
    }
}

impl DensityNodes {
    /// Refuses a node `i` whose arc length does not follow from that of the node before it in its pass.
    fn check_step(&self, i: usize) -> Result<(), Invalid> {
        let Self { arc_length_mm: s, point_mm: p, pass_idx: pass, .. } = self;
        if pass[i] != pass[i - 1] {
            return Ok(());
        }
        if s[i] <= s[i - 1] {
            let problem = format!("is {} after {}", s[i], s[i - 1]);
            let remedy = "arc lengths ascend strictly within a pass";
            return Err(Invalid::at_index("arc_length_mm", i, problem, remedy));
        }
        let distance = (p[i][0] - p[i - 1][0]).hypot(p[i][1] - p[i - 1][1]);
        if (distance - (s[i] - s[i - 1])).abs() > SAME_LENGTH_MM {
            let problem = format!(
                "is {} mm beyond node {}, the points are {distance} mm apart",
                s[i] - s[i - 1],
                i - 1
            );
            let remedy = "arc lengths are those of the points";
            return Err(Invalid::at_index("arc_length_mm", i, problem, remedy));
        }
        Ok(())
    }

    /// Refuses a node `i` that is marked as a corner but is not midway between two nodes of the same pass and density.
    fn check_corner(&self, i: usize) -> Result<(), Invalid> {
        if !self.corner[i] {
            return Ok(());
        }
        let Self { arc_length_mm: s, dwell_density_s_per_mm: t, pass_idx: pass, .. } = self;
        let inside = i > 0 && i + 1 < s.len() && pass[i - 1] == pass[i] && pass[i + 1] == pass[i];
        let problem = if !inside {
            "is at the end of a pass"
        } else if self.corner[i - 1] || self.corner[i + 1] {
            "is next to another corner"
        } else if (s[i + 1] - 2.0 * s[i] + s[i - 1]).abs() > SAME_LENGTH_MM {
            "is not midway between its neighbours"
        } else if [t[i - 1], t[i + 1]].iter().any(|n| (n - t[i]).abs() > SAME_DENSITY * t[i]) {
            "has neighbours of another density"
        } else {
            return Ok(());
        };
        let remedy = "a corner stands midway between two nodes of its pass and density";
        Err(Invalid::at_index("corner", i, problem, remedy))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn density(s: &[f64], t: &[f64], corner: &[bool]) -> Result<DwellDensity, Invalid> {
        let points = s.iter().map(|s| [*s, 1.0]).collect();
        DwellDensity::new(DensityNodes {
            arc_length_mm: s.to_vec(),
            dwell_density_s_per_mm: t.to_vec(),
            point_mm: points,
            pass_idx: vec![0; s.len()],
            corner: corner.to_vec(),
        })
    }

    #[test]
    fn bad_densities_are_refused() {
        let no = [false; 3];
        assert_eq!(density(&[0.0, 1.0, 2.0], &[0.1, 0.2, 0.1], &no).unwrap().len(), 3);
        let message = |s: &[f64], t: &[f64], c: &[bool]| density(s, t, c).unwrap_err().to_string();
        assert!(message(&[0.0], &[0.1], &[false]).contains("has 1 nodes"));
        let m = message(&[0.0, 1.0, 1.0], &[0.1; 3], &no);
        assert!(m.contains("arc_length_mm[2]: is 1 after 1"), "{m}");
        for bad in [0.0, -0.1, f64::NAN] {
            let m = message(&[0.0, 1.0, 2.0], &[0.1, bad, 0.1], &no);
            assert!(m.contains("dwell_density_s_per_mm[1]: is"), "{m}");
        }
        let m = message(&[0.0, 1.0, 2.0], &[0.1; 3], &[true, false, false]);
        assert!(m.contains("corner[0]: is at the end"), "{m}");
        let m = message(&[0.0, 1.0, 3.0], &[0.1; 3], &[false, true, false]);
        assert!(m.contains("midway"), "{m}");
        let m = message(&[0.0, 1.0, 2.0], &[0.1, 0.1, 0.2], &[false, true, false]);
        assert!(m.contains("another density"), "{m}");
        let apart = DwellDensity::new(DensityNodes {
            arc_length_mm: vec![0.0, 1.0],
            dwell_density_s_per_mm: vec![0.1; 2],
            point_mm: vec![[0.0, 0.0], [0.0, 1.1]],
            pass_idx: vec![0; 2],
            corner: vec![false; 2],
        });
        assert!(apart.unwrap_err().to_string().contains("1.1 mm apart"));
    }
}
