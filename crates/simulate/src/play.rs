//! Play of an axis: the carriage moves only where the drive pushes it.
//!
//! With the drive at p(t) and half the play h, the carriage is at q(t) with
//!
//! ```text
//! |p - q| <= h,   q moves up only where q = p - h, and down only where q = p + h
//! ```
//!
//! the play operator of hysteresis (M. A. Krasnosel'skii, A. V. Pokrovskii, Systems with Hysteresis, 1989). On a
//! monotone part of p from a to b it is q <- max(q, p(b) - h) upwards and min(q, p(b) + h) downwards, so that a
//! piecewise cubic motion stays one: each part is cut where the drive reaches the flank. At first the carriage is in
//! the middle of its play.
//!
//! A negative play is the mirror image of the positive one about the drive, p - (q - p): what an error adds has a
//! first order.

use planish_numerics::polynomial::{
    derivative, evaluate, monotone_crossing, quadratic_roots, shifted,
};

use crate::motion::MotionPiece;

/// Sentence for the user on the state in which a run with play begins.
pub const START: &str = "an axis with play begins in the middle of it, so that its first move is half the play \
                         longer; one that was pressed against a flank before the run removes some percent more or \
                         less of what play adds";

/// Distance between drive and flank up to which they touch, mm. It is far above the rounding of coordinates, and far
/// below any play. Larger: a small play is ignored in part. Smaller: rounding decides the contact.
const TOUCHES_MM: f64 = 1e-9;

/// Motion of the carriage of one axis during a part of a piece.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Carriage {
    /// The carriage follows the drive at this distance, q - p, mm.
    Follows(f64),
    /// The carriage stands at this position, mm.
    Stands(f64),
}

impl Carriage {
    /// Returns the coefficients of the motion of the carriage while the drive has the coefficients `c`. `mirrored`
    /// gives the mirror image about the drive, for a negative play.
    fn motion(self, c: [f64; 4], mirrored: bool) -> [f64; 4] {
        let q = match self {
            Self::Follows(distance) => [c[0] + distance, c[1], c[2], c[3]],
            Self::Stands(place_mm) => [place_mm, 0.0, 0.0, 0.0],
        };
        if mirrored { [0, 1, 2, 3].map(|k| 2.0 * c[k] - q[k]) } else { q }
    }
}

/// State of one axis with play.
struct AxisPlay {
    /// Half the play (h of the module), mm.
    half_mm: f64,
    /// Position of the carriage (q of the module), mm; `None` before the motion.
    carriage_mm: Option<f64>,
}

impl AxisPlay {
    /// Follows the drive along the cubic `c` for `duration_s`, and fills `parts` with the motions of the carriage and
    /// the time at which each begins.
    fn follow(&mut self, c: &[f64; 4], duration_s: f64, parts: &mut Vec<(f64, Carriage)>) {
        parts.clear();
        let mut add = |from_s: f64, does: Carriage| {
            if parts.last().is_none_or(|(_, before)| *before != does) {
                parts.push((from_s, does));
            }
        };
        let h = self.half_mm;
        let start = evaluate(c, 0.0);
        // Segments need not join: the drive takes the carriage along where it jumps.
        let mut q = self.carriage_mm.unwrap_or(start).clamp(start - h, start + h);
        let v = derivative(c);
        let mut turns = [duration_s; 3];
        for (turn, root) in turns.iter_mut().zip(quadratic_roots(v[0], v[1], v[2], duration_s)) {
            *turn = root;
        }
        let mut from_s = 0.0;
        for until_s in turns.into_iter().filter(|t| *t > 0.0) {
            if until_s <= from_s {
                continue;
            }
            let (from, until) = (evaluate(c, from_s), evaluate(c, until_s));
            let flank = if until > from { h } else { -h };
            // How far the drive is beyond the flank of the standing carriage, at both ends.
            let beyond = |p: f64| (p - flank - q) * flank.signum();
            if beyond(until) <= TOUCHES_MM {
                add(from_s, Carriage::Stands(q));
            } else {
                if beyond(from) < -TOUCHES_MM {
                    add(from_s, Carriage::Stands(q));
                    from_s = monotone_crossing(c, q + flank, from_s, until_s);
                }
                add(from_s, Carriage::Follows(-flank));
                q = until - flank;
            }
            from_s = until_s;
        }
        self.carriage_mm = Some(q);
    }
}

/// Returns the motion of the carriages, in pieces, if the drives of both axes move along `pieces`, with a play of
/// `play_mm`. `origin` has one index per piece; every new piece gets that of the piece of which it is a part.
pub fn with_play(
    pieces: &[MotionPiece],
    origin: &[usize],
    play_mm: f64,
) -> (Vec<MotionPiece>, Vec<usize>) {
    let mirrored = play_mm < 0.0;
    let half_mm = 0.5 * play_mm.abs();
    let mut axes = [(); 2].map(|()| AxisPlay { half_mm, carriage_mm: None });
    let mut parts = [Vec::new(), Vec::new()];
    let mut cut = Vec::new();
    let mut cut_origin = Vec::new();
    for (p, from) in pieces.iter().zip(origin) {
        for ((axis, c), parts) in axes.iter_mut().zip(&p.coefficient_mm).zip(&mut parts) {
            axis.follow(c, p.duration_s, parts);
        }
        let mut part_of = [0, 0];
        let mut from_s = 0.0;
        while from_s < p.duration_s {
            let next_s =
                [0, 1].map(|a| parts[a].get(part_of[a] + 1).map_or(p.duration_s, |(t, _)| *t));
            let until_s = next_s[0].min(next_s[1]);
            if until_s > from_s {
                let mut part = *p;
                part.start_s = p.start_s + from_s;
                part.duration_s = until_s - from_s;
                part.coefficient_mm = [0, 1].map(|a| {
                    let (_, carriage) = parts[a][part_of[a]];
                    carriage.motion(shifted(&p.coefficient_mm[a], from_s), mirrored)
                });
                cut.push(part);
                cut_origin.push(*from);
            }
            for (part, next_s) in part_of.iter_mut().zip(next_s) {
                *part += usize::from(next_s <= until_s);
            }
            from_s = until_s;
        }
    }
    (cut, cut_origin)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(start_s: f64, duration_s: f64, coefficient_mm: [[f64; 4]; 2]) -> MotionPiece {
        let (tool_on, rate_factor, stay) = (true, 1.0, 0);
        MotionPiece { start_s, duration_s, coefficient_mm, tool_on, rate_factor, stay }
    }

    /// Makes pieces with irregular coefficients whose ends do not join, along x and y.
    fn wild() -> Vec<MotionPiece> {
        let wave = |k: usize, j: usize| (1.0 + 7.3 * k as f64 + 2.9 * j as f64).sin();
        (0..40)
            .map(|k| {
                let c = [0, 1].map(|a| [0, 1, 2, 3].map(|j| wave(k, 4 * a + j)));
                piece(k as f64, 1.0, c)
            })
            .collect()
    }

    /// Returns times, s, and positions q of the carriage of `axis`, mm, in dense steps. In each step q becomes the
    /// position nearest to q within h of the drive p.
    fn dense(pieces: &[MotionPiece], axis: usize, play_mm: f64, steps: usize) -> Vec<(f64, f64)> {
        let h = 0.5 * play_mm;
        let mut q = pieces[0].coefficient_mm[axis][0];
        let mut all = Vec::new();
        for p in pieces {
            for i in 0..=steps {
                let u = p.duration_s * i as f64 / steps as f64;
                let drive = evaluate(&p.coefficient_mm[axis], u);
                q = q.max(drive - h).min(drive + h);
                if i > 0 && i < steps {
                    all.push((p.start_s + u, q));
                }
            }
        }
        all
    }

    fn at(pieces: &[MotionPiece], axis: usize, t: f64) -> f64 {
        let i = pieces.partition_point(|p| p.start_s <= t) - 1;
        evaluate(&pieces[i].coefficient_mm[axis], t - pieces[i].start_s)
    }

    #[test]
    fn the_carriage_is_that_of_dense_steps() {
        let pieces = wild();
        let origin: Vec<usize> = (0..pieces.len()).collect();
        for play in [1e-3, 0.1, 0.7, 3.0] {
            let (cut, of) = with_play(&pieces, &origin, play);
            assert!(of.is_sorted() && of.len() == cut.len());
            let total: f64 = cut.iter().map(|p| p.duration_s).sum();
            // Rounding of a sum of durations of 40 s.
            assert!((total - 40.0).abs() < 1e-12, "{total}");
            let (mirror, _) = with_play(&pieces, &origin, -play);
            for axis in 0..2 {
                for (t, q) in dense(&pieces, axis, play, 2000) {
                    // A turn between two steps is missed by v^2 / 2 a of a step of 5e-4 s, at some 10 mm/s^2.
                    assert!((at(&cut, axis, t) - q).abs() < 2e-5, "{play} {axis} {t}");
                    let drive = at(&pieces, axis, t);
                    let image = drive - (at(&cut, axis, t) - drive);
                    // Rounding of positions.
                    assert!((at(&mirror, axis, t) - image).abs() < 1e-12);
                }
            }
        }
    }

    #[test]
    fn what_is_shorter_than_the_play_moves_nothing() {
        // 5 mm/s, and on it 2 um there and back along y, also as noise of the last digit.
        let there_and_back = |k: usize| {
            let y =
                if k.is_multiple_of(2) { [0.0, 4e-3, -4e-3, 0.0] } else { [0.0, -1e-16, 0.0, 0.0] };
            piece(k as f64, 1.0, [[5.0 * k as f64, 5.0, 0.0, 0.0], y])
        };
        let pieces: Vec<MotionPiece> = (0..10).map(there_and_back).collect();
        let (cut, _) = with_play(&pieces, &[0; 10], 0.02);
        for p in &cut {
            assert_eq!(p.coefficient_mm[1], [0.0; 4]);
        }
        // x follows 0.01 mm later once the drive has gone so far: after 2 ms. One piece is cut, once.
        assert_eq!(cut.len(), 11);
        assert_eq!(cut[0].coefficient_mm[0], [0.0; 4]);
        // Rounding of a root of a linear law.
        assert!((cut[0].duration_s - 0.002).abs() < 1e-12);
        // Rounding of 20 mm.
        assert!((cut[5].coefficient_mm[0][0] - (20.0 - 0.01)).abs() < 1e-12);
    }
}
