//! Report of the scheduler: changes of the densities, and errors of the motion.

use serde::Serialize;

/// Changes of the dwell-time densities, and errors of the motion.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TrigSplineReport {
    /// Number of passes: maximal runs of segments with the tool on.
    pub passes: usize,
    /// Smallest dwell-time density of a dwell point before the repair, s/mm.
    pub smallest_density_s_per_mm: f64,
    /// Offset of all densities that the velocity limit demands, s/mm.
    pub feed_offset_s_per_mm: f64,
    /// Additional offset of all densities that the acceleration limit demands, s/mm.
    pub acceleration_offset_s_per_mm: f64,
    /// Time that the repair, and an offset of the proof, added to the motion, s.
    pub offset_added_s: f64,
    /// Number of nodes that a local repair raised.
    pub raised_nodes: usize,
    /// Number of dwell points whose density was held at half the mean density of the segment, because the neighbours
    /// differ too much.
    pub held_densities: usize,
    /// Time that the held densities added to the motion, s.
    pub held_added_s: f64,
    /// Number of changes of direction with the tool on; a parabola rounds each of them.
    pub corners: usize,
    /// Number of corners at which the tool moves slower than the dwell times demand.
    pub slowed_corners: usize,
    /// Time that slower corners added, braking before and accelerating after them included, s.
    pub corner_added_s: f64,
    /// Largest distance of the motion from a corner of the path, mm.
    pub largest_corner_deviation_mm: f64,
    /// Number of links with the tool off: lifts, run-ups and the last brake.
    pub links: usize,
    /// Sum of the durations of the links, s.
    pub link_s: f64,
    /// Indices of the zero-length segments whose time went to their neighbours, in order.
    pub moved_dwell: Vec<usize>,
    /// Indices of the segments that the motion leaves out, because they have neither length nor dwell time.
    pub dropped: Vec<usize>,
    /// Number of times that the densities of a piece were evened out, because its motion could not be proven; see step
    /// 6 of [`super`].
    pub evened_pieces: usize,
    /// Sum of the offsets of all densities that the proof of the limits added at the end, s/mm.
    pub proof_offset_s_per_mm: f64,
    /// Largest ratio of the feedrate to the velocity limit along the path; 1 = at the limit.
    pub feed_use: f64,
    /// Largest ratio of the acceleration along the path to its limit, by (3) of [`super`]; 1 = at the limit.
    pub acceleration_use: f64,
    /// Largest error of the fitted position, mm: an upper bound, or, if that exceeds the tolerance, the largest error
    /// at 9 points of a cubic.
    pub fit_error_mm: f64,
}
