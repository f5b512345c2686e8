//! The motion in pieces so short that each has one position error and one rate.

use planish_numerics::polynomial::{derivative, evaluate, shifted};
use planish_types::{Invalid, Tif, Trajectory, Variation, budget};

/// Smallest number of parts of equal time into which the run is divided while the tool is on; the error of the rate is
/// constant in each. The error of a linear drift is at most 1/2000 of its size, and its mean is exact. Larger: more
/// pieces, and more time. Smaller: a larger error.
const TIME_PARTS: f64 = 1000.0;

/// A part of the motion so short that one rate and one position error hold in it.
#[derive(Clone, Copy, Debug)]
pub struct MotionPiece {
    /// Time from the start of the motion to the start of the piece, s.
    pub start_s: f64,
    /// Duration of the piece, s.
    pub duration_s: f64,
    /// Ascending coefficients of the cubics [x, y] from the start of the piece, mm/s^k.
    pub coefficient_mm: [[f64; 4]; 2],
    /// True if the tool removes.
    pub tool_on: bool,
    /// Removal rate of the tool relative to its TIF: from a log with the beam current, times the factor of the time of a
    /// tool that has one; else 1.
    pub rate_factor: f64,
    /// Index of the stay that the piece belongs to.
    pub stay: usize,
}

/// A motion in pieces, and in stays. A stay is the part of the motion that serves one dwell point without interruption.
/// Every segment that serves no dwell point is a stay of its own.
#[derive(Clone, Debug)]
pub struct Motion {
    /// Pieces in the order of time.
    pub pieces: Vec<MotionPiece>,
    /// Duration of every stay, s.
    pub stay_s: Vec<f64>,
    /// Index of the dwell point that every stay serves; `None` for a stay that serves none.
    pub point_of_stay: Vec<Option<usize>>,
    /// Duration of the whole motion, s.
    pub total_s: f64,
    /// Time of the run at which the motion starts, s: the first break of the trajectory.
    pub first_s: f64,
}

impl Motion {
    /// Cuts `trajectory` into pieces in which the tool moves at most `longest_mm`, and which last at most 1/1000 of the
    /// run. Segments with the tool off stay whole.
    ///
    /// # Errors
    ///
    /// Refuses a motion whose pieces would not fit into the memory.
    pub fn new(trajectory: &Trajectory, longest_mm: f64) -> Result<Self, Invalid> {
        let total_s = trajectory.total_time_s();
        let parts = trajectory.segments().map(|segment| {
            let travel = travel_mm(segment.coefficient_mm, segment.duration_s) / longest_mm;
            let parts = travel.max(segment.duration_s * TIME_PARTS / total_s).ceil().max(1.0);
            if segment.tool_on { parts } else { 1.0 }
        });
        let parts: Vec<f64> = parts.collect();
        let count = parts.iter().sum();
        let remedy = "give a motion over the part, in mm";
        budget::affordable("coefficient_mm", count, size_of::<MotionPiece>(), remedy)?;
        let first_s = trajectory.break_time_s()[0];
        let mut pieces = Vec::with_capacity(trajectory.len());
        let mut stay_s: Vec<f64> = Vec::new();
        let mut point_of_stay = Vec::new();
        let mut last = None;
        for (segment, parts) in trajectory.segments().zip(parts) {
            // Of segments that serve no point each is a stay.
            if segment.dwell_index.is_none() || last != Some(segment.dwell_index) {
                stay_s.push(0.0);
                point_of_stay.push(segment.dwell_index);
            }
            last = Some(segment.dwell_index);
            let stay = stay_s.len() - 1;
            stay_s[stay] += segment.duration_s;

            let duration_s = segment.duration_s / parts;
            for k in 0..parts as usize {
                let from = k as f64 * duration_s;
                pieces.push(MotionPiece {
                    start_s: segment.start_s - first_s + from,
                    duration_s,
                    coefficient_mm: segment.coefficient_mm.map(|c| shifted(&c, from)),
                    tool_on: segment.tool_on,
                    rate_factor: segment.rate_factor,
                    stay,
                });
            }
        }
        Ok(Self { pieces, stay_s, point_of_stay, total_s, first_s })
    }

    /// Returns the motion with the rate of a tool that depends on the time of the run. Every piece gets the mean of the
    /// factor over its planned time, even if an error stretches the piece.
    pub fn with_rate_of(mut self, tif: &Tif) -> Self {
        if let Some(time) = tif.variation().and_then(Variation::time_factor) {
            for p in &mut self.pieces {
                let from_s = self.first_s + p.start_s;
                p.rate_factor *= time.mean(from_s, from_s + p.duration_s);
            }
        }
        self
    }

    /// Returns the largest speed at the ends and in the middle of the pieces, mm/s.
    pub fn largest_speed_mm_per_s(&self) -> f64 {
        let speeds = self.pieces.iter().flat_map(|p| {
            let [vx, vy] = p.coefficient_mm.map(|c| derivative(&c));
            [0.0, 0.5, 1.0]
                .map(|f| evaluate(&vx, f * p.duration_s).hypot(evaluate(&vy, f * p.duration_s)))
        });
        speeds.fold(0.0, f64::max)
    }
}

/// Returns the length of the path of the cubics `c` over `duration_s`, approximated by eight chords, mm.
fn travel_mm(c: &[[f64; 4]; 2], duration_s: f64) -> f64 {
    let chords = (0..8).map(|k| {
        let [p, q] =
            [k, k + 1].map(|k| [0, 1].map(|a| evaluate(&c[a], duration_s * f64::from(k) / 8.0)));
        (q[0] - p[0]).hypot(q[1] - p[1])
    });
    chords.sum()
}
