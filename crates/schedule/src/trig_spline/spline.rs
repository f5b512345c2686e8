//! Pieces of the spline, equations (1) to (3) of [`super`], and the increase of their densities that the
//! acceleration limit demands.

use std::{f64::consts::PI, sync::LazyLock};

/// Number of bisections for the increase of a density. 2^-60 of the interval is below rounding. Larger: no change.
/// Smaller: the increase of a density is larger than needed.
const BISECTIONS: usize = 60;

/// One piece of the spline of the dwell-time density, between two nodes, (1) of [`super`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrigPiece {
    /// Dwell-time densities at the start and at the end, s/mm; > 0.
    pub density_s_per_mm: [f64; 2],
    /// Length along the path, mm; > 0.
    pub length_mm: f64,
}

/// Position along a piece of the spline, with the dwell-time density there.
#[derive(Clone, Copy, Debug)]
pub(super) struct PiecePlace {
    /// Part of the length before this position, 0 to 1.
    x: f64,
    angle: HalfAngle,
    /// Density at this position by (1) of [`super`], s/mm.
    pub(super) density_s_per_mm: f64,
}

impl TrigPiece {
    fn sum(&self) -> f64 {
        self.density_s_per_mm[0] + self.density_s_per_mm[1]
    }

    fn difference(&self) -> f64 {
        self.density_s_per_mm[1] - self.density_s_per_mm[0]
    }

    /// Returns the eccentricity e = M1/M2: the difference of the densities over their sum, in (-1, 1).
    pub fn eccentricity(&self) -> f64 {
        self.difference() / self.sum()
    }

    /// Returns the duration of the piece, T = L M2/2, s.
    pub fn duration_s(&self) -> f64 {
        0.5 * self.length_mm * self.sum()
    }

    /// Returns the dwell-time density at the fraction `x` (0 to 1) of the length, by (1) of [`super`], s/mm.
    pub fn density_s_per_mm_at(&self, x: f64) -> f64 {
        self.place(x, HalfAngle::new(x)).density_s_per_mm
    }

    /// Returns the positions of both ends of a stretch.
    pub(super) fn ends(&self, stretch: &Stretch) -> [PiecePlace; 2] {
        let [from, to] = stretch.angles();
        [self.place(stretch.from, from), self.place(stretch.to, to)]
    }

    fn place(&self, x: f64, angle: HalfAngle) -> PiecePlace {
        // Half-angle form: no density below the smaller of the two by rounding.
        let [d1, d2] = self.density_s_per_mm;
        let HalfAngle { sine, cosine } = angle;
        let density_s_per_mm = d1 * cosine * cosine + d2 * sine * sine;
        PiecePlace { x, angle, density_s_per_mm }
    }

    /// Returns an upper bound on the fourth time derivative of the position, |d^4 s/dt^4|, between two positions,
    /// mm/s^4.
    pub(super) fn fourth_derivative_bound(&self, ends: [PiecePlace; 2]) -> f64 {
        // ds/dt = 1/D, so d^4 s/dt^4 = (-D''' D^2 + 10 D D' D'' - 15 D'^3) / D^7, and by (1), with
        // q = pi/L and A = M1 q/2,  D' = A sin(pi x),  D'' = A q cos(pi x),  D''' = -A q^2 sin(pi x)
        let sines = ends.map(|place| 2.0 * place.angle.sine * place.angle.cosine);
        let cosines = ends.map(|PiecePlace { angle, .. }| {
            (angle.cosine * angle.cosine - angle.sine * angle.sine).abs()
        });
        // The cosine is largest at an end, and so is the sine unless the middle lies between the ends.
        let has_middle = ends[0].x < 0.5 && ends[1].x > 0.5;
        let sine = if has_middle { 1.0 } else { sines[0].max(sines[1]) };
        let cosine = cosines[0].max(cosines[1]);
        let q = PI / self.length_mm;
        let amplitude = 0.5 * q * self.difference().abs();
        let first = amplitude * sine;
        let second = amplitude * q * cosine;
        let third = first * q * q;
        // D is monotone.
        let least = ends[0].density_s_per_mm.min(ends[1].density_s_per_mm);
        let ratio = first / least;
        (third + ratio * (10.0 * second + 15.0 * ratio * first)) / (least * least).powi(2) / least
    }

    /// Returns the time between the fractions `from` and `to` of the length, s, to its own rounding. If the densities
    /// of the ends differ by orders of magnitude, the difference of two times by (2) of [`super`] would leave no digit
    /// of a short one.
    pub fn elapsed_s(&self, from: f64, to: f64) -> f64 {
        self.time_s(time_weights(from, to))
    }

    /// Returns the time from the start of a stretch to its check point `k`, s; check point [`STRETCH_PLACES`] is its
    /// end.
    pub(super) fn elapsed_s_to(&self, stretch: &Stretch, k: usize) -> f64 {
        self.time_s(stretch.time_weights(k))
    }

    fn time_s(&self, weights: [f64; 2]) -> f64 {
        let [d1, d2] = self.density_s_per_mm;
        self.length_mm * (d1 * weights[0] + d2 * weights[1])
    }

    /// Returns the fraction of the length that is covered after the fraction `m` of the duration. It inverts (2) of
    /// [`super`] by Newton's method within a bracket that bisection narrows.
    pub fn progress(&self, m: f64) -> f64 {
        let e = self.eccentricity();
        let (mut low, mut high) = (0.0, 1.0);
        let mut x = m.clamp(0.0, 1.0);
        for _ in 0..60 {
            // f = x - e/pi sin(pi x) - m,  f' = 1 - e cos(pi x) > 0
            let f = x - e / PI * (PI * x).sin() - m;
            if f.abs() <= f64::EPSILON {
                break;
            }
            if f > 0.0 {
                high = x
            } else {
                low = x
            }
            let next = x - f / (1.0 - e * (PI * x).cos());
            x = if next > low && next < high { next } else { 0.5 * (low + high) };
        }
        x
    }

    /// Returns the largest |acceleration| on the piece, by (3) of [`super`], mm/s^2.
    pub fn peak_acceleration(&self) -> f64 {
        let r = self.eccentricity().abs();
        let [d1, d2] = self.density_s_per_mm;
        // (3) where 1 - r, 1 + r c and 1 + c would cancel: q = 1 - r = 2 min(d)/M2, s^2 = 1 + 24 r^2,
        //   1 + r c = 6 q (1 + r)/(5 + s),    1 - |c| = 2 q/(1 + s + 4 r)
        let q = 2.0 * d1.min(d2) / self.sum();
        let s = (1.0 + 24.0 * r * r).sqrt();
        let below_one = 2.0 * q / (1.0 + s + 4.0 * r);
        let slowest = self.sum() * (6.0 * q * (1.0 + r) / (5.0 + s));
        // 1 - c^2 = (1 - |c|) (1 + |c|); M2^3 (1 + r c)^3 by factors, which neither under- nor overflow
        let sine = (below_one * (2.0 - below_one)).sqrt();
        4.0 * PI * r * sine * (self.sum() / slowest) / (self.length_mm * slowest * slowest)
    }

    fn raised(&self, by: [f64; 2]) -> Self {
        let [d1, d2] = self.density_s_per_mm;
        Self { density_s_per_mm: [d1 + by[0], d2 + by[1]], ..*self }
    }
}

/// Values sin(pi x/2) and cos(pi x/2) at a part x of the length of a piece.
#[derive(Clone, Copy, Debug, PartialEq)]
struct HalfAngle {
    sine: f64,
    cosine: f64,
}

impl HalfAngle {
    fn new(x: f64) -> Self {
        Self { sine: (0.5 * PI * x).sin(), cosine: (0.5 * PI * (1.0 - x)).sin() }
    }
}

/// Returns the time between two parts of the length per mm of the piece, s/mm, for a density of 1 s/mm at one end and 0
/// at the other. The two values are for the density at the start and at the end.
fn time_weights(from: f64, to: f64) -> [f64; 2] {
    // The integral of (1) in half-angle form, w = to - from, m the middle; no term is negative:
    //   of sin^2(pi x/2):  (theta - sin theta)/pi + 2/pi sin^2(pi m/2) sin theta,  theta = pi w/2
    //   of cos^2(pi x/2):  the same with 1 - m
    let theta = 0.5 * PI * (to - from);
    let sine = theta.sin();
    let excess = angle_less_sine(theta);
    [0.5 * ((1.0 - from) + (1.0 - to)), 0.5 * (from + to)]
        .map(|m| (excess + 2.0 * (0.5 * PI * m).sin().powi(2) * sine) / PI)
}

/// Number of equal steps of a stretch; the fit is checked at their ends (check points). Larger: more computing time,
/// and larger tables. Smaller: the error can be larger between two check points; with 10 steps by at most 2 %.
pub(super) const STRETCH_PLACES: usize = 10;

/// Stretch of a piece of the spline: the piece between the fractions `from` and `to` of its length.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stretch {
    pub(super) from: f64,
    pub(super) to: f64,
    /// Number among the stretches made by halving: 1 is the whole piece, 2 k and 2 k + 1 are the halves of k; 0 for any
    /// other.
    halved: usize,
}

impl Stretch {
    /// Stretch that is the whole piece.
    pub(super) const WHOLE: Self = Self { from: 0.0, to: 1.0, halved: 1 };

    /// Returns the stretch between any two parts of the length, 0 to 1.
    pub(super) fn new(from: f64, to: f64) -> Self {
        Self { from, to, halved: 0 }
    }

    pub(super) fn halves(&self) -> [Self; 2] {
        let middle = 0.5 * (self.from + self.to);
        let first = 2 * self.halved;
        let second = first + usize::from(first > 0);
        [
            Self { to: middle, halved: first, ..*self },
            Self { from: middle, halved: second, ..*self },
        ]
    }

    /// Returns the part of the length at the check point `k`.
    pub(super) fn part(&self, k: usize) -> f64 {
        if k == STRETCH_PLACES {
            return self.to;
        }
        self.from + (self.to - self.from) * k as f64 / STRETCH_PLACES as f64
    }

    fn known(&self) -> Option<&'static Known> {
        KNOWN.get(self.halved.wrapping_sub(1))
    }

    fn angles(&self) -> [HalfAngle; 2] {
        self.known().map_or_else(|| [self.from, self.to].map(HalfAngle::new), |known| known.angles)
    }

    fn time_weights(&self, k: usize) -> [f64; 2] {
        let known = self.known().map(|known| known.time_weights[k]);
        known.unwrap_or_else(|| time_weights(self.from, self.part(k)))
    }
}

/// Values on a stretch that depend neither on the densities nor on the length of a piece.
#[derive(Clone, Copy, Debug)]
struct Known {
    angles: [HalfAngle; 2],
    /// Weights of the time, as by [`time_weights`], from the start of the stretch to every check point, the start
    /// included.
    time_weights: [[f64; 2]; STRETCH_PLACES + 1],
}

/// Values of the stretches made by halving, in the order of their numbers, down to 1/128 of a piece.
static KNOWN: LazyLock<Vec<Known>> = LazyLock::new(|| {
    let mut stretches = vec![Stretch::WHOLE];
    for k in 0..127 {
        stretches.extend(stretches[k].halves());
    }
    let known = stretches.iter().map(|s| Known {
        angles: [s.from, s.to].map(HalfAngle::new),
        time_weights: std::array::from_fn(|k| time_weights(s.from, s.part(k))),
    });
    known.collect()
});

/// Returns the difference x - sin x for 0 <= x <= pi/2, accurate also for small x.
fn angle_less_sine(x: f64) -> f64 {
    if x > 0.5 {
        return x - x.sin();
    }
    // x^3/3! - x^5/5! + ...; 0.5^18/19! is below rounding.
    let x2 = x * x;
    let mut term = x * x2 / 6.0;
    let mut sum = 0.0;
    for k in 1..=8 {
        sum += term;
        term *= -x2 / f64::from((2 * k + 2) * (2 * k + 3));
    }
    sum
}

/// Piece of the spline with the acceleration that the machine allows along it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limited {
    pub(super) shape: TrigPiece,
    /// Largest acceleration that the machine allows along the piece, less the margin of the repair, mm/s^2.
    pub(super) max_acceleration: f64,
}

impl Limited {
    pub(super) fn is_too_fast(&self, by: [f64; 2]) -> bool {
        self.shape.raised(by).peak_acceleration() > self.max_acceleration
    }

    /// Returns the smallest offset of both densities, at least `offset`, that keeps the acceleration limit, s/mm.
    /// Raising both densities by the same amount leaves D' and raises D: |D'|/D^3 falls.
    pub(super) fn offset(&self, offset: f64) -> f64 {
        if !self.is_too_fast([offset; 2]) {
            return offset;
        }
        // min(d) + delta >= (pi |M1| / (2 L a))^(1/3) is sufficient: |D'| <= pi |M1| / (2 L).
        let slope = 0.5 * PI * self.shape.difference().abs() / self.shape.length_mm;
        let bound = (slope / self.max_acceleration).cbrt();
        bisect(offset, offset.max(bound), |by| !self.is_too_fast([by; 2]))
    }

    /// Returns the smallest increase of the smaller density that keeps the acceleration limit, s/mm; 0 if it is kept.
    /// `which` is the end with the smaller density: 0 start, 1 end.
    pub(super) fn raise(&self, which: usize) -> f64 {
        if !self.is_too_fast([0.0; 2]) {
            return 0.0;
        }
        bisect(0.0, self.shape.difference().abs(), |amount| {
            let mut by = [0.0; 2];
            by[which] = amount;
            !self.is_too_fast(by)
        })
    }
}

/// Returns the smallest value in (low, high] for which `good` is true, by bisection. `high` is good, and so is every
/// value above a good one.
fn bisect(mut low: f64, mut high: f64, good: impl Fn(f64) -> bool) -> f64 {
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (low + high);
        if good(middle) { high = middle } else { low = middle }
    }
    high
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(d1: f64, d2: f64, length_mm: f64) -> TrigPiece {
        TrigPiece { density_s_per_mm: [d1, d2], length_mm }
    }

    #[test]
    fn the_peak_of_the_acceleration_is_exact() {
        let p = piece(0.02, 0.05, 0.2);
        assert!((p.peak_acceleration() - 11_658.766).abs() < 5e-4, "{}", p.peak_acceleration());
        // a = d(1/D)/dt = -D'/D^3 from differences of (1); the largest of 1e5 samples.
        let (n, step) = (100_000, 1e-6);
        let v = |x: f64| 1.0 / p.density_s_per_mm_at(x);
        let largest = (1..n)
            .map(|i| {
                let x = f64::from(i) / f64::from(n);
                // a = v dv/ds
                v(x) * (v(x + step) - v(x - step)) / (2.0 * step * p.length_mm)
            })
            .fold(0.0, |m: f64, a| m.max(a.abs()));
        assert!((largest / p.peak_acceleration() - 1.0).abs() < 1e-7, "{largest}");
        assert_eq!(piece(0.3, 0.3, 1.0).peak_acceleration(), 0.0);
        // The same backwards; (3) depends on |M1|.
        assert_eq!(piece(0.05, 0.02, 0.2).peak_acceleration(), p.peak_acceleration());
    }

    #[test]
    fn time_is_the_integral_of_the_density_and_is_inverted() {
        // Kepler's equation at M/pi = 0.3.
        assert!((piece(0.02, 0.05, 0.2).eccentricity() - 3.0 / 7.0).abs() < 1e-15);
        assert!((piece(0.02, 0.05, 0.2).progress(0.3) - 0.433_447_626_1).abs() < 1e-10);
        assert!((piece(0.3, 0.1, 1.0).progress(0.3) - 0.204_600_118_2).abs() < 1e-10);
        for (d1, d2) in [(1.0, 1.0), (1.0, 3.0), (5.0, 1e-3), (1e-3, 1.999), (1.999, 1e-3)] {
            let p = piece(d1, d2, 0.7);
            let n = 1000;
            // Simpson's rule, exact to rounding for a cosine at this step.
            let mut t = 0.0;
            for i in 0..n {
                let x = |k: f64| (f64::from(i) + k) / f64::from(n);
                let d = |k: f64| p.density_s_per_mm_at(x(k));
                t += 0.7 / f64::from(n) * (d(0.0) + 4.0 * d(0.5) + d(1.0)) / 6.0;
                assert!(
                    (t - p.elapsed_s(0.0, x(1.0))).abs() < 1e-12 * p.duration_s(),
                    "{d1} {d2} {i}"
                );
                // The residual of the equation; its inverse may be ill-conditioned.
                let m = p.progress(x(1.0));
                let found = p.elapsed_s(0.0, m) / p.duration_s();
                assert!((found - x(1.0)).abs() < 1e-15, "{d1} {d2}: {found} {}", x(1.0));
            }
        }
    }

    #[test]
    fn the_fourth_derivative_is_bounded() {
        for (d1, d2) in [(0.02, 0.05), (0.05, 0.02), (1e-3, 3.0), (0.3, 0.301)] {
            let p = piece(d1, d2, 0.2);
            // d/dt = 1/(D L) d/dx, three times from the feed 1/D, by central differences.
            let step = 1e-3;
            let feed = |x: f64| 1.0 / p.density_s_per_mm_at(x);
            let rate = |f: &dyn Fn(f64) -> f64, x: f64| {
                feed(x) * (f(x + step) - f(x - step)) / (2.0 * step * p.length_mm)
            };
            let second = |x: f64| rate(&feed, x);
            let third = |x: f64| rate(&second, x);
            for (from, to) in [(0.05, 0.1), (0.4, 0.65), (0.5, 0.53), (0.9, 0.95)] {
                let bound = p.fourth_derivative_bound(p.ends(&Stretch::new(from, to)));
                let at = |i: i32| from + (to - from) * f64::from(i) / 50.0;
                let largest = (0..=50).map(|i| rate(&third, at(i)).abs()).fold(0.0, f64::max);
                // The differences are good to some step^2 times (d2 / d1 - 1), at most 1 %.
                assert!(largest <= 1.01 * bound, "{d1} {d2} {from}: {largest} {bound}");
            }
            // At a tenth of a percent of difference only one term counts: the bound is sharp.
            let nearly = piece(0.3, 0.3003, 0.2);
            let bound = nearly.fourth_derivative_bound(nearly.ends(&Stretch::new(0.5, 0.53)));
            let exact = 0.5 * (PI / 0.2).powi(3) * 0.0003 / 0.300_15_f64.powi(5);
            assert!((bound / exact - 1.0).abs() < 0.01, "{bound} {exact}");
        }
    }

    #[test]
    fn what_is_looked_up_is_the_same_to_the_last_bit() {
        let mut stretches = vec![Stretch::WHOLE];
        for k in 0..400 {
            stretches.extend(stretches[k].halves());
        }
        assert!(stretches[254].known().is_some() && stretches[255].known().is_none());
        for s in stretches {
            let same = Stretch::new(s.from, s.to);
            assert_eq!(s.angles(), same.angles());
            for k in 0..=STRETCH_PLACES {
                assert_eq!(s.time_weights(k), same.time_weights(k), "{s:?} {k}");
            }
        }
    }

    #[test]
    fn the_repair_is_the_smallest_and_idempotent() {
        let p = Limited { shape: piece(0.02, 0.05, 0.2), max_acceleration: 2000.0 };
        let offset = p.offset(0.0);
        // The bound of the source with its corrected coefficient: min(d) >= 0.0490223.
        assert!(offset > 0.0 && offset <= 0.049_022_3 - 0.02, "{offset}");
        let peak = |by: f64| p.shape.raised([by; 2]).peak_acceleration();
        assert!(peak(offset) <= 2000.0 && peak(offset - 1e-12) > 2000.0);
        let repaired = Limited { shape: p.shape.raised([offset; 2]), ..p };
        assert_eq!(repaired.offset(0.0), 0.0);
        let raise = p.raise(0);
        assert!(p.shape.raised([raise, 0.0]).peak_acceleration() <= 2000.0);
        assert!(p.shape.raised([raise - 1e-12, 0.0]).peak_acceleration() > 2000.0);
    }

    #[test]
    fn short_times_and_small_densities_keep_their_digits() {
        // Densities 1e9 apart: near the small one D = d1 + d2 sin^2(pi x/2), and over a part w of
        // the length the time is L (d1 w + d2 pi^2 w^3/12) to w^2.
        let (d1, d2) = (1e-3, 1e6);
        let w = 2.0_f64.powi(-20);
        let expected = 3.0 * (d1 * w + d2 * PI * PI * w.powi(3) / 12.0);
        let there = piece(d1, d2, 3.0).elapsed_s(0.0, w);
        // The next term, (pi w/2)^2/5 of the last one, is 1e-12 of the whole.
        assert!((there / expected - 1.0).abs() < 1e-11, "{there} {expected}");
        assert_eq!(piece(d2, d1, 3.0).elapsed_s(1.0 - w, 1.0), there);
        // The parts of a part, from both ends of the cancellation in `angle_less_sine`.
        for (from, to) in [(0.0, 0.25), (0.1, 0.9), (0.3, 0.31), (0.25, 1.0)] {
            let p = piece(d1, d2, 3.0);
            let parts = p.elapsed_s(from, 0.5 * (from + to)) + p.elapsed_s(0.5 * (from + to), to);
            assert!((p.elapsed_s(from, to) / parts - 1.0).abs() < 1e-14, "{from} {to}");
        }
        // (3) for d1/d2 -> 0 at x = pi X/2 sqrt(d2/d1): D = d1 (1 + x^2), a ~ x/(1 + x^2)^3 is
        // largest at x^2 = 1/5: a = pi sqrt(d2/d1) sqrt(1/5) (5/6)^3 / (L d1^2).
        let a = PI * (d2 / d1).sqrt() * 0.2_f64.sqrt() * (5.0_f64 / 6.0).powi(3) / (3.0 * d1 * d1);
        let peak = piece(d1, d2, 3.0).peak_acceleration();
        // To the order d1/d2.
        assert!((peak / a - 1.0).abs() < 1e-8, "{peak} {a}");
    }
}
