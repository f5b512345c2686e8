//! A smooth curve along a tool path: straight lines, and corners rounded by pairs of clothoids.
//!
//! ```text
//! at a vertex of turn phi, from b before it to b after it:
//! kappa(s) = k s / L,  0 <= s <= L,  and mirrored       phi = k L,   r = 1 / k the least radius       (1)
//! x_L = L C(phi), y_L = L S(phi),  C + i S = integral from 0 to 1 of exp(i phi u^2 / 2) du
//! b = x_L + y_L tan(phi / 2),   e = y_L / cos(phi / 2)  the deviation at the vertex                   (2)
//! ```
//!
//! Heading and curvature are continuous, so the acceleration across the path rises from zero and falls to it;
//! arc length, heading and curvature are exact ([`planish_numerics::motion::clothoid`]). A corner takes at most
//! half of its two segments. Where the path turns back on itself no smooth curve follows it: there the machine
//! comes to rest, and the next curve begins.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | phi | `turn_rad` | rad |
//! | L | `half_length_mm` | mm |
//! | b | `cut_mm` | mm |
//! | e | `deviation_mm` | mm |

use std::f64::consts::PI;

use planish_numerics::motion::clothoid;
use planish_types::ToolPath;

/// A turn sharper than this is no corner but a way back: the machine rests there.
pub const SHARPEST_TURN_RAD: f64 = 170.0 / 180.0 * PI;

/// A turn below this is rounding of coordinates: the line goes on.
const NO_TURN_RAD: f64 = 1e-9;

/// How far corners may be rounded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rounding {
    /// Largest distance of the curve from a vertex, mm.
    pub deviation_mm: f64,
    /// Largest least radius of a corner, mm: wider ones need not be, whatever the deviation allows.
    pub radius_mm: f64,
}

/// Where a curve is, and how it runs there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Station {
    /// Position, mm.
    pub point_mm: [f64; 2],
    /// Unit vector along the curve.
    pub tangent: [f64; 2],
    /// Positive to the left, 1/mm.
    pub curvature_per_mm: f64,
}

/// A part of a curve whose curvature is linear in the arc length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    start: Station,
    /// Change of curvature over length, 1/mm^2.
    sharpness_per_mm2: f64,
    /// Arc length from the start of the curve, mm.
    pub from_mm: f64,
    /// Its own arc length, mm.
    pub length_mm: f64,
    /// Segment of the tool path that it follows.
    pub segment: usize,
}

impl Piece {
    /// At a length from the start of the piece, mm.
    pub fn at(&self, s: f64) -> Station {
        let Station { point_mm, tangent, curvature_per_mm } = self.start;
        let [along, across] = clothoid::position(curvature_per_mm, self.sharpness_per_mm2, s);
        let step =
            [tangent[0] * along - tangent[1] * across, tangent[1] * along + tangent[0] * across];
        let (tangent, curvature_per_mm) = self.direction(s);
        let point_mm = [point_mm[0] + step[0], point_mm[1] + step[1]];
        Station { point_mm, tangent, curvature_per_mm }
    }

    /// Unit vector along the curve, and curvature (1/mm), at a length from the start of the piece, mm.
    pub fn direction(&self, s: f64) -> ([f64; 2], f64) {
        let Station { tangent, curvature_per_mm: curvature, .. } = self.start;
        let (sin, cos) = clothoid::heading(curvature, self.sharpness_per_mm2, s).sin_cos();
        let turned = [tangent[0] * cos - tangent[1] * sin, tangent[1] * cos + tangent[0] * sin];
        (turned, curvature + self.sharpness_per_mm2 * s)
    }

    /// Whether it is a straight line.
    pub fn is_straight(&self) -> bool {
        self.start.curvature_per_mm == 0.0 && self.sharpness_per_mm2 == 0.0
    }

    /// Largest change of the heading on it, rad.
    pub fn turn_rad(&self) -> f64 {
        clothoid::heading(self.start.curvature_per_mm, self.sharpness_per_mm2, self.length_mm).abs()
    }

    /// Arc length of its end from the start of the curve, mm.
    pub fn to_mm(&self) -> f64 {
        self.from_mm + self.length_mm
    }
}

/// A corner of a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// Arc length of its middle from the start of the curve, mm.
    pub at_mm: f64,
    /// phi, without its sign, rad.
    pub turn_rad: f64,
    /// Its least radius, mm.
    pub radius_mm: f64,
    /// e, mm.
    pub deviation_mm: f64,
}

/// A smooth curve from rest to rest.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    pieces: Vec<Piece>,
    corners: Vec<Corner>,
}

impl Curve {
    /// Its pieces in order; each begins where the one before ends.
    pub fn pieces(&self) -> &[Piece] {
        &self.pieces
    }

    /// Its corners in order.
    pub fn corners(&self) -> &[Corner] {
        &self.corners
    }

    /// Arc length, mm.
    pub fn length_mm(&self) -> f64 {
        self.pieces.last().map_or(0.0, Piece::to_mm)
    }

    /// The piece at an arc length, mm; of two that meet there the later one.
    pub fn piece_at(&self, s: f64) -> &Piece {
        let after = self.pieces.partition_point(|p| p.from_mm <= s);
        &self.pieces[after.saturating_sub(1)]
    }

    /// At an arc length, mm.
    pub fn at(&self, s: f64) -> Station {
        let piece = self.piece_at(s);
        piece.at((s - piece.from_mm).min(piece.length_mm))
    }

    /// Unit vector along it, and curvature (1/mm), at an arc length, mm.
    pub fn direction(&self, s: f64) -> ([f64; 2], f64) {
        let piece = self.piece_at(s);
        piece.direction((s - piece.from_mm).min(piece.length_mm))
    }

    fn push(&mut self, start: Station, sharpness_per_mm2: f64, length_mm: f64, segment: usize) {
        let from_mm = self.length_mm();
        // Lengths that vanish beside the arc length would be pieces without duration.
        if from_mm + length_mm > from_mm {
            self.pieces.push(Piece { start, sharpness_per_mm2, from_mm, length_mm, segment });
        }
    }
}

/// A segment of the path that has a length.
struct Chord {
    segment: usize,
    from: [f64; 2],
    to: [f64; 2],
    tangent: [f64; 2],
    length_mm: f64,
}

/// (1) and (2) for a turn.
struct Blend {
    cut_mm: f64,
    half_length_mm: f64,
    deviation_mm: f64,
}

impl Blend {
    /// The widest one that the rounding and the room along the two segments allow.
    fn widest(turn_rad: f64, room_mm: f64, rounding: &Rounding) -> Self {
        // For L = 1: heading phi u^2 / 2 means a sharpness of phi.
        let [c, s] = clothoid::position(0.0, turn_rad, 1.0);
        let (cut, deviation) = (c + s * (0.5 * turn_rad).tan(), s / (0.5 * turn_rad).cos());
        let by_deviation =
            if deviation > 0.0 { rounding.deviation_mm / deviation } else { f64::INFINITY };
        // r = L / phi
        let half_length_mm = (room_mm / cut).min(by_deviation).min(rounding.radius_mm * turn_rad);
        Self {
            cut_mm: cut * half_length_mm,
            half_length_mm,
            deviation_mm: deviation * half_length_mm,
        }
    }
}

/// The curves of a path, each from rest to rest; segments without length are left out.
pub fn curves(path: &ToolPath, rounding: &Rounding) -> Vec<Curve> {
    let chords: Vec<Chord> = (0..path.len())
        .filter_map(|segment| {
            let [dx, dy] = path.displacement_mm(segment);
            let length_mm = dx.hypot(dy);
            (length_mm > 0.0).then(|| Chord {
                segment,
                from: path.point_mm()[segment],
                to: path.point_mm()[segment + 1],
                tangent: [dx / length_mm, dy / length_mm],
                length_mm,
            })
        })
        .collect();
    let mut curves = Vec::new();
    let mut curve = Curve { pieces: Vec::new(), corners: Vec::new() };
    let mut cut_before_mm = 0.0;
    for (i, chord) in chords.iter().enumerate() {
        let [tx, ty] = chord.tangent;
        let turn = chords.get(i + 1).map(|next| {
            let [nx, ny] = next.tangent;
            (tx * ny - ty * nx).atan2(tx * nx + ty * ny)
        });
        let blend = match (turn, chords.get(i + 1)) {
            (Some(turn), Some(next)) if (NO_TURN_RAD..=SHARPEST_TURN_RAD).contains(&turn.abs()) => {
                let room_mm = 0.5 * chord.length_mm.min(next.length_mm);
                Some((turn, next, Blend::widest(turn.abs(), room_mm, rounding)))
            }
            _ => None,
        };
        let cut_mm = blend.as_ref().map_or(0.0, |(_, _, b)| b.cut_mm);
        let start = Station {
            point_mm: [chord.from[0] + cut_before_mm * tx, chord.from[1] + cut_before_mm * ty],
            tangent: chord.tangent,
            curvature_per_mm: 0.0,
        };
        curve.push(start, 0.0, chord.length_mm - cut_before_mm - cut_mm, chord.segment);
        cut_before_mm = cut_mm;
        if let Some((turn, next, blend)) = blend {
            curve.round(chord, next, turn, &blend);
        } else if turn.is_none_or(|turn| turn.abs() > SHARPEST_TURN_RAD) {
            let empty = Curve { pieces: Vec::new(), corners: Vec::new() };
            curves.push(std::mem::replace(&mut curve, empty));
        }
    }
    curves.retain(|c| !c.pieces.is_empty());
    curves
}

impl Curve {
    /// The corner between two chords.
    fn round(&mut self, chord: &Chord, next: &Chord, turn: f64, blend: &Blend) {
        let ([tx, ty], v, l) = (chord.tangent, chord.to, blend.half_length_mm);
        let peak = turn / l;
        let start = Station {
            point_mm: [v[0] - blend.cut_mm * tx, v[1] - blend.cut_mm * ty],
            tangent: chord.tangent,
            curvature_per_mm: 0.0,
        };
        self.push(start, peak / l, l, chord.segment);
        let at_mm = self.length_mm();
        // The middle lies on the bisector, towards the inside.
        let inside = [next.tangent[0] - tx, next.tangent[1] - ty];
        let size = inside[0].hypot(inside[1]);
        let e = blend.deviation_mm;
        let half = [tx + next.tangent[0], ty + next.tangent[1]];
        let length = half[0].hypot(half[1]);
        let middle = Station {
            point_mm: [v[0] + e * inside[0] / size, v[1] + e * inside[1] / size],
            tangent: [half[0] / length, half[1] / length],
            curvature_per_mm: peak,
        };
        self.push(middle, -peak / l, l, next.segment);
        let turn_rad = turn.abs();
        self.corners.push(Corner { at_mm, turn_rad, radius_mm: l / turn_rad, deviation_mm: e });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(points: &[[f64; 2]]) -> ToolPath {
        let n = points.len() - 1;
        ToolPath::through(points.to_vec(), vec![true; n], vec![0; n]).unwrap()
    }

    const WIDE: Rounding = Rounding { deviation_mm: 10.0, radius_mm: 100.0 };

    #[test]
    fn pieces_join_in_position_and_heading_and_curvature() {
        let points = [[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [1.0, 2.5], [4.0, 4.0], [9.0, -1.0]];
        let narrow = Rounding { deviation_mm: 0.05, radius_mm: 0.4 };
        for rounding in [WIDE, narrow] {
            let curves = curves(&path(&points), &rounding);
            assert_eq!(curves.len(), 1);
            let curve = &curves[0];
            assert_eq!(curve.corners().len(), 4);
            for w in curve.pieces().windows(2) {
                let (end, start) = (w[0].at(w[0].length_mm), w[1].at(0.0));
                for k in 0..2 {
                    // Coordinates of some mm, rounded some tens of times.
                    assert!((end.point_mm[k] - start.point_mm[k]).abs() < 1e-13);
                    assert!((end.tangent[k] - start.tangent[k]).abs() < 1e-13);
                }
                let gap = (end.curvature_per_mm - start.curvature_per_mm).abs();
                assert!(gap < 1e-12 * start.curvature_per_mm.abs().max(1.0));
            }
            let (first, last) = (curve.at(0.0), curve.at(curve.length_mm()));
            assert_eq!(first.point_mm, points[0]);
            assert!((last.point_mm[0] - 9.0).abs() + (last.point_mm[1] + 1.0).abs() < 1e-13);
        }
    }

    #[test]
    fn a_corner_keeps_its_deviation_and_its_radius() {
        let corner = |turn: f64, rounding: Rounding| {
            let to = [10.0 + 10.0 * turn.cos(), 10.0 * turn.sin()];
            let curve = curves(&path(&[[0.0, 0.0], [10.0, 0.0], to]), &rounding).remove(0);
            let c = curve.corners()[0];
            let middle = curve.at(c.at_mm).point_mm;
            ((middle[0] - 10.0).hypot(middle[1]), 1.0 / curve.at(c.at_mm).curvature_per_mm, c)
        };
        for turn in [0.1, 1.0, 0.5 * PI, 2.5, 2.9] {
            let (distance, radius, c) =
                corner(turn, Rounding { deviation_mm: 0.1, radius_mm: 100.0 });
            assert!((distance - c.deviation_mm).abs() < 1e-13 && c.deviation_mm <= 0.1 + 1e-15);
            assert!((radius - c.radius_mm).abs() < 1e-12 * radius, "{turn}");
            let (distance, radius, _) =
                corner(turn, Rounding { deviation_mm: 9.0, radius_mm: 0.3 });
            assert!((radius - 0.3).abs() < 1e-13 && distance > 0.0);
        }
        // 90 degrees, L = 1: C = 0.94... by the series of the Fresnel integrals,
        // C = 1 - a^2/10 + a^4/216, S = a/3 - a^3/42 + a^5/1320, a = phi / 2 = pi / 4
        let a = 0.25 * PI;
        let c = 1.0 - a.powi(2) / 10.0 + a.powi(4) / 216.0 - a.powi(6) / 9360.0;
        let s = a / 3.0 - a.powi(3) / 42.0 + a.powi(5) / 1320.0 - a.powi(7) / 75_600.0;
        let blend = Blend::widest(0.5 * PI, 2.0, &WIDE);
        // The next terms of the series are below 2e-7.
        assert!((blend.cut_mm - 2.0).abs() < 1e-14);
        assert!((blend.half_length_mm - 2.0 / (c + s)).abs() < 2e-6);
        let deviation = blend.half_length_mm * s * 2f64.sqrt();
        assert!((blend.deviation_mm - deviation).abs() < 2e-6);
    }

    #[test]
    fn the_arc_length_is_that_of_the_curve() {
        let curve =
            curves(&path(&[[0.0, 0.0], [2.0, 0.0], [2.5, 1.5], [0.0, 3.0]]), &WIDE).remove(0);
        let steps = 20_000;
        let at = |k: usize| curve.at(curve.length_mm() * k as f64 / steps as f64).point_mm;
        let chord = |k: usize| (at(k + 1)[0] - at(k)[0]).hypot(at(k + 1)[1] - at(k)[1]);
        let length: f64 = (0..steps).map(chord).sum();
        // A chord is shorter than its arc by kappa^2 h^3 / 24 with h = 3e-4: 1e-7 of the whole at kappa = 5.
        assert!((length / curve.length_mm() - 1.0).abs() < 2e-7);
    }

    #[test]
    fn the_machine_rests_where_the_path_turns_back() {
        let there_and_back =
            curves(&path(&[[0.0, 0.0], [4.0, 0.0], [4.0, 0.0], [1.0, 0.0], [1.0, 2.0]]), &WIDE);
        let lengths: Vec<usize> = there_and_back.iter().map(|c| c.pieces().len()).collect();
        assert_eq!(lengths.len(), 2);
        assert_eq!(there_and_back[0].length_mm(), 4.0);
        assert_eq!(there_and_back[1].corners().len(), 1);
        assert_eq!(there_and_back[1].pieces()[0].segment, 2);
        assert!(curves(&path(&[[1.0, 1.0], [1.0, 1.0]]), &WIDE).is_empty());
    }
}
