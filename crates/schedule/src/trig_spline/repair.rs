//! Repair of densities that the machine cannot follow: steps 2, 3 and 6 of [`super`]. They are raised
//! by one offset or only where needed, at corners, and where a motion could not be proven.

use serde::Serialize;

use super::{
    passes::{Node, Pass},
    report::TrigSplineReport,
};

/// Repair of the densities that the machine cannot follow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Repair {
    /// Add one offset to all densities.
    #[default]
    Offset,
    /// Raise only the densities that need it.
    Local,
}

impl Repair {
    /// Returns the name of the repair in settings and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Offset => "offset",
            Self::Local => "local",
        }
    }
}

/// Number of rounds of the proof that even out single pieces: they raise the smaller density of a piece to the
/// geometric mean of both. Densities that differ by a factor of 1e15 differ by 1.15 after them. Larger: more rounds
/// before the offset. Smaller: an offset lengthens the whole motion although single pieces would do.
const EVENING_ROUNDS: usize = 8;

/// Largest number of rounds of the proof. Rounds after [`EVENING_ROUNDS`] add an offset, which halves all relative
/// differences. Larger: a hopeless case runs longer. Smaller: the scheduler refuses dwell times that another offset
/// would make possible.
pub(super) const PROOF_ROUNDS: usize = 16;

/// Repairs the densities by step 2 of [`super`]; `how` selects one offset or local changes, which `report` gets. The
/// offset grows piece by piece, and no piece is visited twice.
pub(super) fn repair(passes: &mut [Pass], how: Repair, report: &mut TrigSplineReport) {
    let before: f64 = passes.iter().map(Pass::duration_s).sum();
    let smallest = dwell_points(passes).map(|n| n.density).fold(f64::INFINITY, f64::min);
    report.smallest_density_s_per_mm = if smallest.is_finite() { smallest } else { 0.0 };
    match how {
        Repair::Offset => {
            // delta >= 1/v_max - min d
            let feed = dwell_points(passes).map(|n| n.least - n.density).fold(0.0, f64::max);
            let pieces = passes.iter().flat_map(Pass::pieces);
            let offset = pieces.fold(feed, |offset, piece| piece.offset(offset));
            report.feed_offset_s_per_mm = feed;
            report.acceleration_offset_s_per_mm = offset - feed;
            let nodes = passes.iter_mut().flat_map(|p| &mut p.nodes);
            nodes.for_each(|n| n.density += offset);
        }
        Repair::Local => {
            for pass in passes.iter_mut() {
                for n in pass.nodes.iter_mut().filter(|n| n.density < n.least) {
                    n.density = n.least;
                    report.raised_nodes += 1;
                }
                report.raised_nodes += sweep(pass);
            }
        }
    }
    report.offset_added_s = passes.iter().map(Pass::duration_s).sum::<f64>() - before;
}

/// Returns the nodes of all passes that are dwell points, not corners.
fn dwell_points(passes: &[Pass]) -> impl Iterator<Item = &Node> {
    passes.iter().flat_map(|p| &p.nodes).filter(|n| n.half_length_mm == 0.0)
}

/// Raises the densities at corners to the least ones that the limits allow, and those beside them as far as braking
/// needs it, by step 3 of [`super`].
pub(super) fn slow_at_corners(passes: &mut [Pass], report: &mut TrigSplineReport) {
    let before: f64 = passes.iter().map(Pass::duration_s).sum();
    for pass in passes.iter_mut() {
        for n in pass.nodes.iter_mut().filter(|n| n.density < n.least) {
            n.density = n.least;
            report.slowed_corners += 1;
        }
        sweep(pass);
    }
    report.corner_added_s = passes.iter().map(Pass::duration_s).sum::<f64>() - before;
}

/// Raises the smaller density of every piece until the piece keeps its acceleration limit, along the path and back.
/// Returns the number of raised nodes. Raising the smaller end of a piece keeps a limit that was kept, so one sweep
/// each way is enough.
fn sweep(pass: &mut Pass) -> usize {
    let n = pass.nodes.len();
    let mut raised = 0;
    let forth = (1..n).map(|k| (k - 1, 1));
    let back = (1..n).rev().map(|k| (k - 1, 0));
    for (k, which) in forth.chain(back) {
        let piece = pass.piece(k);
        let [d1, d2] = piece.shape.density_s_per_mm;
        if (which == 1) == (d2 < d1) {
            let by = piece.raise(which);
            raised += usize::from(by > 0.0);
            pass.nodes[k + which].density += by;
        }
    }
    raised
}

/// Raises densities of the `unproven` pieces (index of the pass, index of the first node), by step 6 of [`super`]. In
/// later rounds it adds an offset to all densities.
pub(super) fn ease(
    passes: &mut [Pass],
    unproven: &[(usize, usize)],
    round: usize,
    report: &mut TrigSplineReport,
) {
    let before: f64 = passes.iter().map(Pass::duration_s).sum();
    if round < EVENING_ROUNDS {
        report.evened_pieces += unproven.len();
        for &(p, k) in unproven {
            let [a, b] = [0, 1].map(|end| passes[p].nodes[k + end].density);
            let smaller = if a < b { k } else { k + 1 };
            let node = &mut passes[p].nodes[smaller];
            node.density = node.density.max(a.sqrt() * b.sqrt());
        }
        // Nodes are only raised, so that they keep every limit that they kept. A sweep then repairs the
        // acceleration of the pieces beside them.
        passes.iter_mut().for_each(|pass| {
            sweep(pass);
        });
    } else {
        let densities = passes.iter().flat_map(|p| &p.nodes).map(|n| n.density);
        let offset = densities.fold(0.0, f64::max);
        report.proof_offset_s_per_mm += offset;
        passes.iter_mut().flat_map(|p| &mut p.nodes).for_each(|n| n.density += offset);
    }
    report.offset_added_s += passes.iter().map(Pass::duration_s).sum::<f64>() - before;
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_testkit::machine;
    use planish_types::{DwellTime, ToolPath};

    #[test]
    fn what_cannot_be_proven_is_evened_out_and_nothing_is_lowered() {
        let points: Vec<[f64; 2]> =
            (0..=30).map(|i| [f64::from(i / 3), 0.5 * f64::from(i % 2)]).collect();
        let path = ToolPath::through(points, vec![true; 30], vec![0; 30]).unwrap();
        let t = (0..30).map(|i| [1e-3, 2.0, 0.1][i % 3]).collect();
        let limits = machine([50.0; 2], [300.0, 200.0]);
        let mut report = TrigSplineReport::default();
        let dwell = DwellTime::new(t).unwrap();
        let mut passes = vec![Pass::new(&path, &dwell, &limits, 0.02, 0..30, &mut report)];
        repair(&mut passes, Repair::Local, &mut report);
        slow_at_corners(&mut passes, &mut report);
        let time_s = passes[0].duration_s();
        let added_s = report.offset_added_s;
        let unproven = [(0, 4), (0, 17), (0, 40)];
        let ratio = |pass: &Pass, k: usize| {
            let [a, b] = [k, k + 1].map(|k| pass.nodes[k].density);
            (a / b).ln().abs()
        };
        assert!(unproven.iter().any(|(_, k)| ratio(&passes[0], *k) > 0.1));
        for round in 0..PROOF_ROUNDS {
            let before = passes[0].clone();
            ease(&mut passes, &unproven, round, &mut report);
            for (a, b) in before.nodes.iter().zip(&passes[0].nodes) {
                assert!(b.density >= a.density && b.density >= b.least);
            }
            assert!(passes[0].pieces().all(|p| !p.is_too_fast([0.0; 2])), "round {round}");
            if round >= EVENING_ROUNDS {
                // Twice the largest, and no less for the others.
                let n = before.nodes.len();
                assert!((1..n).all(|k| ratio(&passes[0], k - 1) <= 0.7 * ratio(&before, k - 1)));
            }
        }
        assert_eq!(report.evened_pieces, EVENING_ROUNDS * unproven.len());
        let added_s = report.offset_added_s - added_s;
        assert!((passes[0].duration_s() - time_s - added_s).abs() < 1e-9 * added_s);
    }
}
