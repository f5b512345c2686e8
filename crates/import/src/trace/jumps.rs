//! Jumps in a log: steps from one sample to the next, or to one sample and back, that no axis can make.
//!
//! An axis that moves fast does so for several samples: the steps before and after a large one are large. A lost revolution
//! of an encoder, a damaged line or a change of the zero is a large step between small ones. It is named, and the motion
//! follows it: only the user knows what the machine did.

use std::borrow::Cow;

use planish_types::text::significant;

/// Smallest ratio of a jump to the steps beside it, and to the median of the steps of the axis that are not 0. Larger:
/// smaller jumps pass. Smaller: fast moves that last one sample are doubted.
const OVER_THE_OTHERS: f64 = 10.0;

/// Smallest jump relative to the range of the positions (largest minus smallest) in the whole log. Larger: small jumps
/// pass. Smaller: the noise of an encoder at rest is doubted.
const OF_THE_WAY: f64 = 1e-3;

/// Largest fraction of the steps that may be jumps; one jump is always reported. If more are large, the log has few
/// samples per move of the axis, and none is reported. Larger: usual moves are reported. Smaller: logs with several
/// jumps are not.
const MOST_OF_THE_STEPS: f64 = 0.01;

/// Measured positions of an axis, with their times.
pub struct LoggedAxis<'a> {
    /// Name of the axis, such as `x`.
    pub name: String,
    /// Unit of its positions, mm or deg.
    pub unit: &'static str,
    /// Times of the samples (n), s.
    pub time_s: &'a [f64],
    /// Positions of the samples (n), in that unit.
    pub positions: Cow<'a, [f64]>,
}

/// Returns a warning about the largest jump of an axis and the number of its jumps; `None` if it has none.
pub fn doubt(axis: &LoggedAxis<'_>) -> Option<String> {
    let jumps = jumps(&axis.positions);
    let largest = *jumps.iter().max_by(|a, b| a.size.abs().total_cmp(&b.size.abs()))?;
    let Jump { index, size, is_back } = largest;
    let others = match jumps.len() {
        1 => String::new(),
        n => format!("; it is the largest of {n} jumps"),
    };
    Some(format!(
        "{} jumps by {} {unit} from sample {index} to the next, from {} to {} {unit} at {} s{}{others}: a lost count of the \
         encoder, or a damaged line? the motion follows it; correct the log, or cut it by `from_s` and `until_s`",
        axis.name,
        significant(size, 4),
        significant(axis.positions[index], 6),
        significant(axis.positions[index + 1], 6),
        significant(axis.time_s[index], 6),
        if is_back { ", and back" } else { "" },
        unit = axis.unit
    ))
}

/// A jump of an axis: the index of the sample before it, and its size in the unit of the axis, with its sign.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Jump {
    index: usize,
    size: f64,
    /// True if the next step goes back, to within a fifth of the jump.
    is_back: bool,
}

/// Returns the jumps among the positions: steps far larger than the steps beside them, and than most others. The list
/// is empty if so many steps are large that they are usual moves.
fn jumps(positions: &[f64]) -> Vec<Jump> {
    let steps: Vec<f64> = positions.windows(2).map(|p| p[1] - p[0]).collect();
    let low = positions.iter().copied().fold(f64::INFINITY, f64::min);
    let high = positions.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let least = (OF_THE_WAY * (high - low)).max(OVER_THE_OTHERS * median_of_moves(&steps));
    let mut jumps = Vec::new();
    let mut i = 0;
    while i < steps.len() {
        let step = steps[i];
        // Outside of the log the axis rests.
        let [before, after, next] = [i.checked_sub(1), Some(i + 1), Some(i + 2)]
            .map(|i| i.and_then(|i| steps.get(i)).copied().unwrap_or(0.0));
        let is_back = i + 1 < steps.len() && (after + step).abs() < 0.2 * step.abs();
        let [beside, around] = [after, next].map(|other| before.abs().max(other.abs()));
        if step.abs() > least && step.abs() > OVER_THE_OTHERS * beside {
            jumps.push(Jump { index: i, size: step, is_back: false });
        } else if is_back && step.abs() > least && step.abs() > OVER_THE_OTHERS * around {
            jumps.push(Jump { index: i, size: step, is_back: true });
            i += 1;
        }
        i += 1;
    }
    if jumps.len() as f64 > (MOST_OF_THE_STEPS * steps.len() as f64).max(1.0) {
        jumps.clear();
    }
    jumps
}

/// Returns the median magnitude of the steps that are not 0; returns 0 if there are fewer than two of them.
fn median_of_moves(steps: &[f64]) -> f64 {
    let mut moves: Vec<f64> = steps.iter().map(|step| step.abs()).filter(|s| *s > 0.0).collect();
    if moves.len() < 2 {
        return 0.0;
    }
    let middle = moves.len() / 2;
    *moves.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns positions, mm, of a raster line at 50 mm/s that turns at its ends: 2 s at 1 kHz.
    fn line() -> Vec<f64> {
        (0..2000).map(|i| 20.0 * (f64::from(i) * 0.0025).sin()).collect()
    }

    #[test]
    fn a_lost_revolution_and_a_spike_are_jumps() {
        let mut lost = line();
        lost[700..].iter_mut().for_each(|x| *x += 64.0);
        let found = jumps(&lost);
        assert_eq!((found.len(), found[0].index, found[0].is_back), (1, 699, false));
        // 64 mm and a step of 0.05 mm at most.
        assert!((found[0].size - 64.0).abs() < 0.06);
        let mut spike = line();
        spike[700] -= 64.0;
        let found = jumps(&spike);
        assert_eq!((found.len(), found[0].index, found[0].is_back), (1, 699, true));
        let time_s: Vec<f64> = (0..2000).map(|i| f64::from(i) * 1e-3).collect();
        let axis =
            LoggedAxis { name: "x".into(), unit: "mm", time_s: &time_s, positions: spike.into() };
        let said = doubt(&axis).unwrap();
        assert!(
            said.contains("x jumps by -64") && said.contains("sample 699 to the next"),
            "{said}"
        );
        assert!(said.contains("0.699 s, and back"), "{said}");
    }

    #[test]
    fn the_motion_of_a_machine_has_no_jumps() {
        assert!(jumps(&line()).is_empty());
        // Steps of 1 mm in one sample between rests.
        let steps: Vec<f64> = (0..2000).map(|i| f64::from(i / 100)).collect();
        assert!(jumps(&steps).is_empty());
        // A start from rest with the largest acceleration, and an encoder at rest with a count of noise.
        let start: Vec<f64> = (0..500).map(|i| (f64::from(i) - 100.0).clamp(0.0, 200.0)).collect();
        assert!(jumps(&start).is_empty());
        let noise: Vec<f64> = (0..1000).map(|i| if i % 97 == 0 { 1e-4 } else { 0.0 }).collect();
        assert!(jumps(&noise).is_empty());
        assert!(jumps(&[0.0, 0.0, 0.0]).is_empty());
    }
}
