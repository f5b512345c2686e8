//! The verdict against closed forms, invariants and dense sampling.

use planish_types::{Limits, MachineFile, MachineFileAxis, Trajectory};
use planish_verify::{Check, Program, Verdict, VerifySettings, verify};
use proptest::prelude::*;

/// Ascending coefficients of one axis.
type Cubic = [f64; 4];

fn machine(velocity: f64, acceleration: f64, jerk: Option<f64>, min_segment_s: f64) -> Limits {
    let axis = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: velocity,
        max_acceleration_mm_per_s2: acceleration,
        max_jerk_mm_per_s3: jerk,
        ..MachineFileAxis::default()
    };
    MachineFile {
        name: "test".into(),
        axes: vec![axis("x"), axis("y")],
        min_segment_s,
        ..MachineFile::default()
    }
    .checked()
    .unwrap()
}

/// Returns a trajectory from durations, s, and coefficients of x; y rests at 0. Dwell indices count from 100.
fn along_x(duration_s: &[f64], x: &[Cubic]) -> Trajectory {
    both(duration_s, x, &vec![[0.0; 4]; x.len()])
}

fn both(duration_s: &[f64], x: &[Cubic], y: &[Cubic]) -> Trajectory {
    let mut breaks = vec![0.0];
    for h in duration_s {
        breaks.push(breaks[breaks.len() - 1] + h);
    }
    let k = duration_s.len();
    let c = x.iter().zip(y).map(|(x, y)| [*x, *y]).collect();
    let index = (100..100 + k).map(Some).collect();
    Trajectory::new(breaks, c, vec![true; k], index).unwrap()
}

/// Returns the cubics through the positions `p` with the velocities `v` at the ends of segments of duration `h`.
fn hermite(p: &[f64], v: &[f64], h: f64) -> Vec<Cubic> {
    let segment = |i: usize| {
        let d = p[i + 1] - p[i];
        [
            p[i],
            v[i],
            (3.0 * d - h * (2.0 * v[i] + v[i + 1])) / (h * h),
            (-2.0 * d + h * (v[i] + v[i + 1])) / (h * h * h),
        ]
    };
    (0..p.len() - 1).map(segment).collect()
}

fn judge(trajectory: &Trajectory, limits: &Limits) -> Verdict {
    verify(trajectory, limits, &VerifySettings::default()).unwrap()
}

fn near(found: f64, expected: f64, tolerance: f64) {
    assert!((found - expected).abs() <= tolerance, "found {found}, expected {expected}");
}

/// Rounding of numbers of the order of 1 to 100 after ten operations.
const ROUNDING: f64 = 1e-12;

#[test]
fn a_known_cubic() {
    // p = u^3 - 3u on [0, 3]: p in [-2 at u = 1, 18], v = 3u^2 - 3 in [-3 at 0, 24],
    // a = 6u in [0, 18], jerk 6.
    let verdict = judge(&along_x(&[3.0], &[[0.0, -3.0, 0.0, 1.0]]), &machine(1e3, 1e3, None, 0.0));
    let x = &verdict.axes[0];
    let range = |c: &Check| [c.min.value, c.min.time_s, c.max.value, c.max.time_s];
    assert_eq!(range(&x.position_mm), [-2.0, 1.0, 18.0, 3.0]);
    assert_eq!(range(&x.velocity_mm_per_s), [-3.0, 0.0, 24.0, 3.0]);
    assert_eq!(range(&x.acceleration_mm_per_s2), [0.0, 0.0, 18.0, 3.0]);
    assert_eq!([x.jerk_mm_per_s3.min.value, x.jerk_mm_per_s3.max.value], [6.0, 6.0]);
    // It starts at -3 mm/s (step 0 -> -3) and ends at 24 mm/s (step 24 -> 0).
    let step = &x.velocity_step_mm_per_s;
    assert_eq!((step.min.value, step.min.index, step.min.time_s), (-24.0, 1, 3.0));
    assert_eq!((step.max.value, step.exceeding_count), (-3.0, 2));
    assert_eq!(step.worst.iter().map(|w| w.value).collect::<Vec<_>>(), [-24.0, -3.0]);
    // It leaves [0, 18] by 2, and moves back at up to 3 mm/s.
    assert_eq!(verdict.max_overshoot_mm, [2.0, 0.0]);
    assert_eq!(x.overshoot_mm.largest.unwrap().time_s, 1.0);
    assert_eq!((x.reversal_mm_per_s.count, x.reversal_mm_per_s.largest.unwrap().value), (1, 3.0));
    // y rests.
    assert_eq!(verdict.max_velocity_mm_per_s, [24.0, 0.0]);
    assert_eq!(
        (verdict.axes[1].overshoot_mm.count, verdict.axes[1].reversal_mm_per_s.count),
        (0, 0)
    );
}

#[test]
fn overshoot_beyond_the_upper_and_the_lower_end() {
    // x = 3u - u^3 on [0, 3] ends at -18 and first rises to 2 at u = 1, where it turns: 2 mm above
    // [-18, 0], and forwards (against its way) at up to 3 mm/s. y, its mirror image, falls 2 below.
    let (x, y) = ([0.0, 3.0, 0.0, -1.0], [0.0, -3.0, 0.0, 1.0]);
    // In the second segment x climbs 1 -> 2 monotonically and y rests: nothing.
    let (x2, y2) = ([1.0, 1.0, 0.0, 0.0], [5.0, 0.0, 0.0, 0.0]);
    let verdict = judge(&both(&[3.0, 1.0], &[x, x2], &[y, y2]), &machine(1e3, 1e3, None, 0.0));
    assert_eq!(verdict.max_overshoot_mm, [2.0, 2.0]);
    for axis in &verdict.axes {
        let largest = axis.overshoot_mm.largest.unwrap();
        assert_eq!((axis.overshoot_mm.count, largest.index, largest.time_s), (1, 0, 1.0));
        assert_eq!(axis.reversal_mm_per_s.count, 1);
        assert_eq!(axis.reversal_mm_per_s.largest.unwrap().value, 3.0);
    }
}

#[test]
fn bang_bang_at_the_limits_is_kept_and_beyond_them_is_not() {
    // d = 5 mm at a = 20 mm/s^2: T = 2 sqrt(d/a) = 1 s, v = sqrt(a d) = 10 mm/s.
    let x = [[0.0, 0.0, 10.0, 0.0], [2.5, 10.0, -10.0, 0.0]];
    let trajectory = along_x(&[0.5, 0.5], &x);
    let verdict = judge(&trajectory, &machine(10.0, 20.0, None, 0.5));
    assert!(verdict.limits_respected, "{:?}", verdict.violations);
    assert_eq!(verdict.reason(), None);
    assert_eq!(verdict.max_velocity_mm_per_s, [10.0, 0.0]);
    assert_eq!(verdict.max_acceleration_mm_per_s2, [20.0, 0.0]);
    assert_eq!(verdict.max_velocity_step_mm_per_s, [0.0, 0.0]);
    // +20, then -40 in the middle, then +20 to rest.
    assert_eq!(verdict.max_acceleration_step_mm_per_s2, [40.0, 0.0]);
    let step = &verdict.axes[0].acceleration_step_mm_per_s2;
    assert_eq!((step.min.value, step.min.index, step.max.value), (-40.0, 1, 20.0));
    assert_eq!((step.limit, step.exceeded), (None, false));

    // 1e-8 above the allowance of 1e-9 on each limit is an excess, and the sign does not matter.
    for sign in [1.0, -1.0] {
        let t = along_x(&[0.5, 0.5], &x.map(|c| c.map(|v| sign * v)));
        let tight = 1.0 - 1e-8;
        let verdict = judge(&t, &machine(10.0 * tight, 20.0, None, 0.0));
        assert!(!verdict.limits_respected);
        assert!(verdict.reason().unwrap().contains("x velocity reaches"), "{verdict:?}");
        let verdict = judge(&t, &machine(10.0, 20.0 * tight, None, 0.0));
        assert_eq!(verdict.axes[0].acceleration_mm_per_s2.exceeding_count, 2);
        assert!(judge(&t, &machine(10.0 * (1.0 - 1e-10), 20.0, None, 0.0)).limits_respected);
    }
}

#[test]
fn acceleration_steps_count_only_against_a_limit_on_jerk() {
    let x = [[0.0, 0.0, 10.0, 0.0], [2.5, 10.0, -10.0, 0.0]];
    let verdict = judge(&along_x(&[0.5, 0.5], &x), &machine(10.0, 20.0, Some(1e9), 0.0));
    assert_eq!(verdict.violations.len(), 1);
    assert!(verdict.violations[0].contains("x acceleration steps by -40 mm/s^2 at break 1"));
    assert_eq!(verdict.axes[0].acceleration_step_mm_per_s2.exceeding_count, 3);
    // The jerk itself: 6 c3 = 6 > 5.
    let t = along_x(&[1.0], &[[0.0, 0.0, 0.0, 1.0]]);
    let verdict = judge(&t, &machine(1e3, 1e3, Some(5.0), 0.0));
    assert_eq!(verdict.axes[0].jerk_mm_per_s3.worst_ratio, Some(1.2));
    assert!(verdict.axes[0].jerk_mm_per_s3.exceeded);
}

#[test]
fn a_hermite_cubic_with_known_accelerations_and_a_peak_between_its_nodes() {
    // p = (0, 1, 3, 4), h = 1, v = (0, 1.8, 1.8, 0): the clamped spline. One-sided accelerations
    // (2.4, 1.2, -1.2) and (1.2, -1.2, -2.4) join without a step. The middle segment has V1 = 3*2 -
    // 1.8 - 1.8 = 2.4, so max v = (v0 v1 - V1^2)/(v0 - 2 V1 + v1) = -2.52/-1.2 = 2.1.
    let x = hermite(&[0.0, 1.0, 3.0, 4.0], &[0.0, 1.8, 1.8, 0.0], 1.0);
    let trajectory = along_x(&[1.0; 3], &x);
    let verdict = judge(&trajectory, &machine(2.1, 2.4, None, 0.0));
    assert!(verdict.limits_respected, "{:?}", verdict.violations);
    let axis = &verdict.axes[0];
    near(axis.velocity_mm_per_s.max.value, 2.1, ROUNDING);
    near(axis.velocity_mm_per_s.max.time_s, 1.5, ROUNDING);
    near(axis.acceleration_mm_per_s2.max.value, 2.4, ROUNDING);
    near(axis.acceleration_mm_per_s2.min.value, -2.4, ROUNDING);
    near(axis.jerk_mm_per_s3.min.value, -2.4, ROUNDING);
    near(axis.jerk_mm_per_s3.max.value, -1.2, ROUNDING);
    // Inside, no step; from rest to 2.4 at the start, from -2.4 to rest at the end.
    near(verdict.max_velocity_step_mm_per_s[0], 0.0, ROUNDING);
    near(axis.acceleration_step_mm_per_s2.max.value, 2.4, ROUNDING);
    let inner = along_x(&[1.0], &x[1..2]);
    near(
        judge(&inner, &machine(9.0, 9.0, None, 0.0)).max_acceleration_step_mm_per_s2[0],
        1.2,
        ROUNDING,
    );
    assert_eq!((axis.overshoot_mm.count, axis.reversal_mm_per_s.count), (0, 0));

    // The nodes all keep 2.0 mm/s; the motion between them does not.
    let verdict = judge(&trajectory, &machine(2.0, 2.4, None, 0.0));
    let velocity = &verdict.axes[0].velocity_mm_per_s;
    assert_eq!((velocity.exceeding_count, velocity.worst[0].index), (1, 1));
    assert_eq!(velocity.worst[0].dwell_index, Some(101));
    near(velocity.worst_ratio.unwrap(), 1.05, ROUNDING);
    assert_eq!(
        verdict.reason().unwrap(),
        "x velocity reaches 2.100000 mm/s in segment 1 at 1.500000 s, 1.050000 times the limit of \
         2 mm/s (segments that exceed it: 1)"
    );
}

#[test]
fn a_jump_is_a_step_in_position_at_its_break() {
    // Rests at 0, at 3, at 1: position mode.
    let rest = |p: f64| [p, 0.0, 0.0, 0.0];
    let trajectory = both(&[1.0; 3], &[rest(0.0); 3], &[rest(0.0), rest(3.0), rest(1.0)]);
    let verdict = judge(&trajectory, &machine(1.0, 1.0, None, 0.0));
    assert!(!verdict.limits_respected);
    let step = &verdict.axes[1].position_step_mm;
    assert_eq!((step.max.value, step.max.index, step.max.time_s), (3.0, 1, 1.0));
    assert_eq!((step.min.value, step.min.index, step.min.dwell_index), (-2.0, 2, Some(102)));
    assert_eq!(step.worst.iter().map(|w| w.value).collect::<Vec<_>>(), [3.0, -2.0]);
    assert_eq!((verdict.max_position_step_mm, verdict.violations.len()), ([0.0, 3.0], 1));
    assert!(verdict.reason().unwrap().starts_with("y position steps by 3 mm at break 1"));
    // A tolerance decides what is a jump: 3.0 is not above 3.0, but above 2.9.
    let with = |t: f64| VerifySettings { position_step_mm: t, ..Default::default() };
    let kept = |t: f64| verify(&trajectory, &machine(1.0, 1.0, None, 0.0), &with(t)).unwrap();
    assert!(kept(3.0).limits_respected && !kept(2.9).limits_respected);
    assert_eq!(kept(2.9).axes[1].position_step_mm.exceeding_count, 1);
    // A start far from the origin is no jump.
    let t = both(&[1.0], &[rest(50.0)], &[rest(-7.0)]);
    assert!(judge(&t, &machine(1.0, 1.0, None, 0.0)).limits_respected);
}

#[test]
fn velocity_steps_inside_and_at_both_ends() {
    let limits = machine(10.0, 10.0, None, 0.0);
    // 2 mm/s, then 5 mm/s: steps +2, +3, -5.
    let verdict =
        judge(&along_x(&[1.0, 1.0], &[[0.0, 2.0, 0.0, 0.0], [2.0, 5.0, 0.0, 0.0]]), &limits);
    let step = &verdict.axes[0].velocity_step_mm_per_s;
    assert_eq!(
        step.worst.iter().map(|w| (w.index, w.value)).collect::<Vec<_>>(),
        [(2, -5.0), (1, 3.0), (0, 2.0)]
    );
    assert_eq!(verdict.max_velocity_step_mm_per_s, [5.0, 0.0]);
    assert_eq!(verdict.max_position_step_mm, [0.0, 0.0]);
    // Only the start moves: v = 1 - u on [0, 1] ends at rest. Reversed, only the end does.
    for (c, index) in [([0.0, 1.0, -0.5, 0.0], 0), ([0.0, 0.0, 0.5, 0.0], 1)] {
        let verdict = judge(&along_x(&[1.0], &[c]), &limits);
        let step = &verdict.axes[0].velocity_step_mm_per_s;
        assert_eq!((step.exceeding_count, step.worst[0].index), (1, index));
        assert_eq!(verdict.violations.len(), 1);
    }
    // The default tolerance is 1e-6 mm/s and 1e-9 of 10 mm/s: 1.01e-6.
    let start = |v: f64| judge(&along_x(&[1.0], &[[0.0, v, -0.5 * v, 0.0]]), &limits);
    assert!(start(1.0099e-6).limits_respected && !start(1.0101e-6).limits_respected);
}

#[test]
fn segments_shorter_than_the_controller_accepts() {
    let x = [[0.0; 4]; 4];
    let limits = machine(1.0, 1.0, None, 0.01);
    let verdict = judge(&along_x(&[0.01, 0.02, 0.005, 0.009], &x), &limits);
    let check = &verdict.segment_duration_s;
    assert_eq!((check.exceeding_count, check.worst[0].index, check.worst[1].index), (2, 2, 3));
    near(check.worst_ratio.unwrap(), 2.0, ROUNDING);
    assert!(verdict.reason().unwrap().contains("segment duration is"));
    // 0.01 s as the difference of two break times at 1e6 s is short by up to 1e-10 s: rounding.
    let breaks: Vec<f64> = (0..=100).map(|i| 1e6 + 0.01 * f64::from(i)).collect();
    let t = Trajectory::new(breaks, vec![[[0.0; 4]; 2]; 100], vec![true; 100], vec![Some(0); 100]);
    let t = t.unwrap();
    assert!((0..100).any(|i| t.segment(i).duration_s < 0.01 * (1.0 - 5e-9)));
    assert!(judge(&t, &limits).limits_respected);
}

#[test]
fn the_twenty_worst_are_listed_worst_first() {
    let v = |i: usize| ((i * 37) % 101) as f64;
    let x: Vec<Cubic> = (0..101).map(|i| [0.0, v(i), 0.0, 0.0]).collect();
    let verdict = judge(&along_x(&[1.0; 101], &x), &machine(50.0, 1.0, None, 0.0));
    let velocity = &verdict.axes[0].velocity_mm_per_s;
    assert_eq!(velocity.exceeding_count, 50);
    let listed: Vec<f64> = velocity.worst.iter().map(|w| w.value).collect();
    assert_eq!(listed, (81..=100).rev().map(f64::from).collect::<Vec<_>>());
    for w in &velocity.worst {
        assert_eq!((v(w.index), w.dwell_index), (w.value, Some(100 + w.index)));
    }
}

#[test]
fn numbers_that_would_defeat_a_comparison_are_refused() {
    let limits = machine(1.0, 1.0, None, 0.0);
    let settings = VerifySettings::default();
    let t = along_x(&[1.0, 1.0], &[[0.0; 4], [0.0, 0.0, 1e308, -1e308]]);
    let message = verify(&t, &limits, &settings).unwrap_err().to_string();
    assert!(message.contains("coefficient_mm[1]"), "{message}");
    let message = verify(&along_x(&[1e200], &[[0.0; 4]]), &limits, &settings).unwrap_err();
    assert!(message.to_string().contains("break_time_s[1]"));
    let t = along_x(&[1.0], &[[0.0; 4]]);
    for bad in [-1.0, f64::NAN, f64::INFINITY] {
        let settings = VerifySettings { velocity_step_mm_per_s: bad, ..settings };
        assert!(verify(&t, &limits, &settings).is_err());
        let settings = VerifySettings { position_step_mm: bad, ..VerifySettings::default() };
        assert!(verify(&t, &limits, &settings).is_err());
    }
}

fn cubics() -> impl Strategy<Value = (Vec<f64>, Vec<Cubic>, Vec<Cubic>)> {
    let cubic = || prop::array::uniform4(-10.0..10.0_f64);
    (1..6_usize).prop_flat_map(move |k| {
        (
            prop::collection::vec(0.05..2.0_f64, k),
            prop::collection::vec(cubic(), k),
            prop::collection::vec(cubic(), k),
        )
    })
}

/// Returns the cubic with its time stretched by `k`: p(u / k).
fn stretched(c: &Cubic, k: f64) -> Cubic {
    [c[0], c[1] / k, c[2] / (k * k), c[3] / (k * k * k)]
}

/// Returns the cubic run backwards: p(h - u).
fn reversed(c: &Cubic, h: f64) -> Cubic {
    [
        c[0] + h * (c[1] + h * (c[2] + h * c[3])),
        -(c[1] + h * (2.0 * c[2] + h * 3.0 * c[3])),
        c[2] + 3.0 * h * c[3],
        -c[3],
    ]
}

/// Rounding of numbers up to 10 (1 + 2 + 4 + 8) and of their derivatives, up to 1e3: a few units in
/// the last place.
const RANDOM_ROUNDING: f64 = 1e-11;

fn same(a: [f64; 2], b: [f64; 2], factor: f64) -> Result<(), TestCaseError> {
    for axis in 0..2 {
        let tolerance = RANDOM_ROUNDING * factor.max(1.0);
        prop_assert!((a[axis] - factor * b[axis]).abs() <= tolerance, "{a:?} {b:?} {factor}");
    }
    Ok(())
}

proptest! {
    #[test]
    fn ranges_hold_every_sample_and_stay_within_the_sampling_bound((h, x, y) in cubics()) {
        const STEPS: u32 = 400;
        let verdict = judge(&both(&h, &x, &y), &machine(1.0, 1.0, None, 0.0));
        for (axis, c) in verdict.axes.iter().zip([&x, &y]) {
            // Extremes of the sampled position, velocity and acceleration, and a bound on their
            // distance from the true ones: (step)^2 / 8 times the largest second derivative.
            let mut sampled = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
            let mut bound = [0.0_f64; 3];
            for (c, h) in c.iter().zip(&h) {
                let step = h / f64::from(STEPS);
                for n in 0..=STEPS {
                    let u = step * f64::from(n);
                    // Powers written out: not the nested form that the judge uses.
                    let values = [
                        c[0] + c[1] * u + c[2] * u.powi(2) + c[3] * u.powi(3),
                        c[1] + 2.0 * c[2] * u + 3.0 * c[3] * u.powi(2),
                        2.0 * c[2] + 6.0 * c[3] * u,
                    ];
                    for (s, v) in sampled.iter_mut().zip(values) {
                        *s = [s[0].min(v), s[1].max(v)];
                    }
                }
                let a_max = (2.0 * c[2]).abs() + (6.0 * c[3] * h).abs();
                let curvature = [a_max, (6.0 * c[3]).abs(), 0.0];
                for (b, k) in bound.iter_mut().zip(curvature) {
                    *b = b.max(step * step / 8.0 * k);
                }
            }
            let proven =
                [&axis.position_mm, &axis.velocity_mm_per_s, &axis.acceleration_mm_per_s2];
            for ((proven, [low, high]), bound) in proven.into_iter().zip(sampled).zip(bound) {
                prop_assert!(proven.max.value >= high - RANDOM_ROUNDING);
                prop_assert!(proven.min.value <= low + RANDOM_ROUNDING);
                prop_assert!(proven.max.value <= high + bound + RANDOM_ROUNDING);
                prop_assert!(proven.min.value >= low - bound - RANDOM_ROUNDING);
            }
        }
    }

    #[test]
    fn slower_by_k_is_v_over_k_a_over_k2_jerk_over_k3((h, x, y) in cubics(), k in 0.5..4.0_f64) {
        let limits = machine(1.0, 1.0, None, 0.0);
        let fast = judge(&both(&h, &x, &y), &limits);
        let slow = |c: &[Cubic]| c.iter().map(|c| stretched(c, k)).collect::<Vec<_>>();
        let h: Vec<f64> = h.iter().map(|h| h * k).collect();
        let slow = judge(&both(&h, &slow(&x), &slow(&y)), &limits);
        same(slow.max_position_step_mm, fast.max_position_step_mm, 1.0)?;
        same(slow.max_velocity_mm_per_s, fast.max_velocity_mm_per_s, 1.0 / k)?;
        same(slow.max_velocity_step_mm_per_s, fast.max_velocity_step_mm_per_s, 1.0 / k)?;
        same(slow.max_acceleration_mm_per_s2, fast.max_acceleration_mm_per_s2, k.powi(-2))?;
        same(
            slow.max_acceleration_step_mm_per_s2,
            fast.max_acceleration_step_mm_per_s2,
            k.powi(-2),
        )?;
        same(slow.max_jerk_mm_per_s3, fast.max_jerk_mm_per_s3, k.powi(-3))?;
        same(slow.max_overshoot_mm, fast.max_overshoot_mm, 1.0)?;
    }

    #[test]
    fn run_backwards_the_magnitudes_are_the_same((h, x, y) in cubics()) {
        let limits = machine(1.0, 1.0, None, 0.0);
        let forth = judge(&both(&h, &x, &y), &limits);
        let back = |c: &[Cubic]| {
            c.iter().zip(&h).rev().map(|(c, h)| reversed(c, *h)).collect::<Vec<_>>()
        };
        let h_back: Vec<f64> = h.iter().rev().copied().collect();
        let back = judge(&both(&h_back, &back(&x), &back(&y)), &limits);
        same(back.max_velocity_mm_per_s, forth.max_velocity_mm_per_s, 1.0)?;
        same(back.max_acceleration_mm_per_s2, forth.max_acceleration_mm_per_s2, 1.0)?;
        same(back.max_jerk_mm_per_s3, forth.max_jerk_mm_per_s3, 1.0)?;
        same(back.max_position_step_mm, forth.max_position_step_mm, 1.0)?;
        same(back.max_velocity_step_mm_per_s, forth.max_velocity_step_mm_per_s, 1.0)?;
        same(back.max_acceleration_step_mm_per_s2, forth.max_acceleration_step_mm_per_s2, 1.0)?;
        same(back.max_overshoot_mm, forth.max_overshoot_mm, 1.0)?;
        for axis in 0..2 {
            // The velocity itself changes its sign.
            let (b, f) = (&back.axes[axis].velocity_mm_per_s, &forth.axes[axis].velocity_mm_per_s);
            prop_assert!((b.max.value + f.min.value).abs() <= RANDOM_ROUNDING);
            prop_assert_eq!(
                back.axes[axis].reversal_mm_per_s.count,
                forth.axes[axis].reversal_mm_per_s.count
            );
        }
    }
}

/// Returns a motion of piecewise constant jerk from rest to rest as a controller's program has it: cubics through its
/// positions and velocities at nodes that are none of its own breaks. The motion is the integral of j(t) = J s(t), s =
/// +-1.
fn program_of(jerk: f64, nodes: &[f64]) -> Trajectory {
    // Rest to rest: + - - + + ... in steps of 0.25 s; the last motion goes back.
    let signs = [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0];
    let at = |t: f64| {
        let (mut p, mut v, mut a) = (0.0, 0.0, 0.0);
        for (k, s) in signs.iter().enumerate() {
            let h = (t - 0.25 * k as f64).clamp(0.0, 0.25);
            let j = s * jerk;
            p += h * (v + h * (a / 2.0 + h * j / 6.0));
            v += h * (a + h * j / 2.0);
            a += h * j;
        }
        (p, v)
    };
    let cubic = |w: &[f64]| {
        let (h, [(p, v), (q, u)]) = (w[1] - w[0], [at(w[0]), at(w[1])]);
        hermite(&[p, q], &[v, u], h)[0]
    };
    let h: Vec<f64> = nodes.windows(2).map(|w| w[1] - w[0]).collect();
    along_x(&h, &nodes.windows(2).map(cubic).collect::<Vec<_>>())
}

#[test]
fn the_program_of_a_motion_within_the_jerk_limit_keeps_it_and_steps_by_less_than_8_27ths() {
    let settings = VerifySettings { program: Some(Program::Cubics), ..VerifySettings::default() };
    let jerk = 100.0;
    // Segments of 0.03 to 0.09 s, off the breaks at multiples of 0.25 s.
    let mut nodes = vec![0.0];
    while nodes[nodes.len() - 1] < 1.9 {
        nodes.push(nodes[nodes.len() - 1] + 0.03 + 0.06 * (nodes.len() as f64 * 0.618).fract());
    }
    nodes.push(2.0);
    let program = program_of(jerk, &nodes);
    let machine = |jerk| machine(1e3, 1e3, Some(jerk), 0.0);
    let kept = verify(&program, &machine(jerk), &settings).unwrap();
    assert!(kept.limits_respected, "{:?}", kept.violations);
    let step = kept.max_acceleration_step_mm_per_s2[0];
    assert!(step > 0.5 && step <= 8.0 / 27.0 * jerk * (2.0 * 0.09), "{step}");
    // A motion that is no program may not step; nor may a program by more than the limit does between two middles.
    assert!(!judge(&program, &machine(jerk)).limits_respected);
    let stricter = verify(&program, &machine(0.9 * jerk), &settings).unwrap();
    assert!(stricter.violations[0].contains("jerk reaches"), "{:?}", stricter.violations);
    // Constant acceleration from rest: a step of 20 mm/s^2 before a segment of 1 s, J T / 2 = 50 or 19.8 mm/s^2.
    let bang = along_x(&[1.0, 1.0], &[[0.0, 0.0, 10.0, 0.0], [10.0, 20.0, -10.0, 0.0]]);
    // In the middle the step is twice as large, and so is the time beside it.
    assert!(verify(&bang, &machine(100.0), &settings).unwrap().limits_respected);
    let beyond = verify(&bang, &machine(39.6), &settings).unwrap();
    assert_eq!(beyond.axes[0].acceleration_step_mm_per_s2.exceeding_count, 3);
    // How a controller joins lines is not known.
    let lines = VerifySettings { program: Some(Program::Lines), ..settings };
    assert!(verify(&bang, &machine(39.6), &lines).unwrap().limits_respected);
    assert!(
        beyond.violations[0].contains("of the program steps by 20 mm/s^2 at break 0")
            || beyond.violations[0].contains("of the program steps by -40 mm/s^2 at break 1"),
        "{:?}",
        beyond.violations
    );
}

/// Returns a machine with the axes x, y, z, a and b, a limit on jerk, and a travel of b.
fn five_axes() -> planish_types::Machine {
    let linear = ["x", "y", "z"].map(|name| {
        serde_json::json!({"name": name, "max_velocity_mm_per_s": 10, "max_acceleration_mm_per_s2": 20})
    });
    let rotary = ["a", "b"].map(|name| {
        serde_json::json!({"name": name, "max_velocity_deg_per_s": 5, "max_acceleration_deg_per_s2": 8,
            "max_jerk_deg_per_s3": 30, "travel_deg": [-20, 20]})
    });
    let kinematics = serde_json::json!({"kind": "xyz-tilts", "pivot_mm": 0, "tilts": ["a", "b"]});
    let file = serde_json::json!({"name": "m", "axes": linear, "rotary_axes": rotary, "kinematics": kinematics});
    planish_types::Machine::new(serde_json::from_value(file).unwrap()).unwrap()
}

#[test]
fn a_motion_of_all_axes_is_judged_by_the_limits_of_each() {
    use planish_types::AxesMotion;
    // b turns by 4 degrees in 2 s as one cubic: v = 3 in the middle, a = +-6 at the ends, jerk -6; the acceleration
    // steps from 0 by 6, which a jerk of 30 may do in 0.2 s, and half the first segment is 1 s.
    let b =
        |start: f64, way: f64, h: f64| [start, 0.0, 3.0 * way / (h * h), -2.0 * way / (h * h * h)];
    let motion = |c: [f64; 4], h: f64| {
        let mut all = vec![[0.0; 4]; 5];
        all[4] = c;
        AxesMotion::new(vec![0.0, h], all, vec![true], vec![None]).unwrap()
    };
    let judged = |c: [f64; 4], h: f64| {
        let judged =
            planish_verify::verify_axes(&motion(c, h), &five_axes(), &VerifySettings::default());
        judged.unwrap()
    };
    let kept = judged(b(0.0, 4.0, 2.0), 2.0);
    assert!(kept.limits_respected, "{:?}", kept.violations);
    let axis = &kept.axes[4];
    assert_eq!(
        (axis.name.as_str(), axis.unit.as_str(), axis.travel),
        ("b", "deg", Some([-20.0, 20.0]))
    );
    near(axis.velocity.magnitude(), 3.0, ROUNDING);
    near(axis.acceleration.magnitude(), 6.0, ROUNDING);
    near(axis.jerk.magnitude(), 6.0, ROUNDING);
    near(axis.acceleration_step.magnitude(), 6.0, ROUNDING);

    // Each of its own: 7 degrees (v = 5.25), 17 degrees beyond the travel, 1 s (a = 24, jerk 48, step 24 of 15).
    for (c, h, words) in [
        (b(0.0, 7.0, 2.0), 2.0, &["b velocity reaches 5.25"][..]),
        (b(17.0, 4.0, 2.0), 2.0, &["b position reaches 21.000000 deg"]),
        (
            b(0.0, 4.0, 1.0),
            1.0,
            &[
                "b velocity",
                "b acceleration reaches",
                "b jerk reaches",
                "b acceleration of the program",
            ],
        ),
        ([0.0, 1.0, 0.0, 0.0], 2.0, &["b velocity steps by 1 deg/s"]),
    ] {
        let verdict = judged(c, h);
        assert!(!verdict.limits_respected);
        for words in words {
            assert!(
                verdict.violations.iter().any(|v| v.contains(words)),
                "{:?} {words}",
                verdict.violations
            );
        }
    }
    let two = AxesMotion::new(vec![0.0, 1.0], vec![[0.0; 4]; 2], vec![true], vec![None]).unwrap();
    let refused = planish_verify::verify_axes(&two, &five_axes(), &VerifySettings::default());
    let message = refused.unwrap_err().to_string();
    assert!(
        message.contains("coefficient_mm_or_deg: has 2 axes, and the machine has x, y, z, a, b"),
        "{message}"
    );
}
