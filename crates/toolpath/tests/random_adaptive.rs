//! The random-adaptive path: what is promised of it, over shapes, pitches and seeds.

use std::path::Path;

use ndarray::{Array1, Array2};
use planish_handoff::artifact;
use planish_testkit::program::save;
use planish_toolpath::{
    random_adaptive::{Construction, RandomAdaptive, RandomAdaptiveSettings, random_adaptive},
    statistics,
};
use planish_types::{Axis, Grid, Surface, ToolPath};
use proptest::prelude::*;

const BOTH: [Construction; 2] = [Construction::MeshTree, Construction::Tour];

fn settings(construction: Construction) -> RandomAdaptiveSettings {
    RandomAdaptiveSettings {
        pitch_mm: 1.0,
        overscan_mm: 2.0,
        step_mm: None,
        contrast: 1.0,
        construction,
        rounding_passes: 1,
        seed: 7,
    }
}

/// Makes a map of the desired removal, nm, with pixels of `pixel` mm; `removal(x, y)` is NaN outside.
fn map(size: [f64; 2], pixel: f64, removal: impl Fn(f64, f64) -> f64) -> Surface {
    let [x, y] = size.map(|s| Axis::new(0.0, pixel, (s / pixel).round() as usize + 1).unwrap());
    let height = Array2::from_shape_fn((y.len(), x.len()), |(r, c)| {
        removal(x.coordinate_mm(c), y.coordinate_mm(r))
    });
    Surface::new(Grid { x, y }, height).unwrap()
}

fn only(inside: bool) -> f64 {
    if inside { 1.0 } else { f64::NAN }
}

/// Returns the number of pairs of steps with the tool on that meet; neighbours do not count.
///
/// Coordinates are rounded to 2^-30 mm, so that every determinant is exact in 128 bits.
fn crossings(path: &ToolPath) -> usize {
    type P = [i128; 2];
    let snap = |p: [f64; 2]| p.map(|v| (v * f64::from(1 << 30)).round() as i128);
    let point = path.point_mm();
    let on: Vec<usize> = (0..path.len()).filter(|i| path.tool_on()[*i]).collect();
    let mut segments: Vec<(P, P)> =
        on.iter().map(|i| (snap(point[*i]), snap(point[i + 1]))).collect();
    segments.sort_unstable_by_key(|(a, b)| a[0].min(b[0]));
    let side =
        |a: P, b: P, c: P| ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).signum();
    let mut count = 0;
    for (k, (a, b)) in segments.iter().enumerate() {
        let right = a[0].max(b[0]);
        for (c, d) in segments[k + 1..].iter().take_while(|(c, d)| c[0].min(d[0]) <= right) {
            let beside = a[1].max(b[1]) < c[1].min(d[1]) || c[1].max(d[1]) < a[1].min(b[1]);
            let neighbours = a == d || b == c;
            let meet = side(*a, *b, *c) * side(*a, *b, *d) <= 0
                && side(*c, *d, *a) * side(*c, *d, *b) <= 0;
            count += usize::from(!beside && !neighbours && meet);
        }
    }
    count
}

/// Returns true if all passes are closed, with lifts between them only.
fn is_closed(path: &ToolPath) -> bool {
    let (point, pass) = (path.point_mm(), path.pass_idx());
    let on: Vec<usize> = (0..path.len()).filter(|i| path.tool_on()[*i]).collect();
    on.chunk_by(|i, j| pass[*i] == pass[*j]).all(|steps| {
        let last = steps[steps.len() - 1];
        point[steps[0]] == point[last + 1] && last - steps[0] + 1 == steps.len()
    })
}

fn make(surface: &Surface, settings: &RandomAdaptiveSettings) -> RandomAdaptive {
    random_adaptive(surface, settings).unwrap()
}

fn lifts(path: &ToolPath) -> usize {
    path.tool_on().iter().filter(|on| !**on).count()
}

#[test]
fn the_pitch_is_the_area_over_the_length() {
    let surface = map([40.0, 25.0], 0.25, |x, _| 10.0 + x);
    for construction in BOTH {
        for (pitch_mm, step_mm, contrast) in
            [(1.0, None, 1.0), (0.7, Some(0.7), 0.5), (1.5, Some(1.0), 0.0)]
        {
            let settings =
                RandomAdaptiveSettings { pitch_mm, step_mm, contrast, ..settings(construction) };
            let made = make(&surface, &settings);
            let pitch = statistics(&made.path, &surface).effective_pitch_mm.unwrap();
            println!("{construction:?}: pitch {pitch} mm of {pitch_mm} mm");
            // Regression bound: measured 0.7 % on these three pitches.
            assert!((pitch / pitch_mm - 1.0).abs() < 0.02, "{settings:?}: {pitch}");
            assert_eq!((crossings(&made.path), lifts(&made.path)), (0, 0));
            assert!(is_closed(&made.path));
        }
    }
}

#[test]
fn the_length_per_area_follows_the_root_of_the_density() {
    // r = 1.6 and 0.4 about a mean of 1: rho ratio 4, spacing ratio 2 at b = 1.
    let surface = map([80.0, 50.0], 0.5, |x, _| if x < 40.0 { 1.6 } else { 0.4 });
    for construction in BOTH {
        for (contrast, ratio) in [(1.0, 2.0), (0.5, 2.0_f64.sqrt())] {
            let path =
                make(&surface, &RandomAdaptiveSettings { contrast, ..settings(construction) }).path;
            // Away from the smoothed step and from the border.
            let within = |low: f64, high: f64| -> f64 {
                let inside = |i: &usize| {
                    let [x, y] = path.dwell_point_mm()[*i];
                    (low..high).contains(&x) && (3.0..47.0).contains(&y)
                };
                let steps = (0..path.len()).filter(inside);
                steps.map(|i| path.segment_length_mm(i)).sum()
            };
            let measured = within(3.0, 30.0) / within(50.0, 77.0);
            // 27 x 44 mm hold about 100 triangles of the wide spacing: some per cent of noise.
            assert!((measured / ratio - 1.0).abs() < 0.15, "{construction:?} {ratio}: {measured}");
        }
    }
}

#[test]
fn a_flat_or_partly_negative_map_has_a_law_too() {
    for removal in [|_: f64, _: f64| 0.0, |x: f64, y: f64| (0.3 * x).sin() * y - 3.0] {
        let surface = map([20.0, 20.0], 0.5, removal);
        let made = make(&surface, &settings(Construction::MeshTree));
        let report = made.report;
        // 4^-1 <= rho <= 4: the spacing varies by at most 4.
        assert!(report.largest_spacing_mm <= 4.0 * report.smallest_spacing_mm, "{report:?}");
    }
}

#[test]
fn every_seed_has_its_path_whatever_the_threads() {
    let surface = map([30.0, 20.0], 0.5, |x, y| x + y);
    let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
    for construction in BOTH {
        let with = |threads: usize, seed| {
            let settings = RandomAdaptiveSettings { seed, ..settings(construction) };
            pool(threads).install(|| make(&surface, &settings))
        };
        let first = with(1, 3);
        assert_eq!(first, with(2, 3));
        assert_ne!(first, with(1, 4));
    }
}

#[test]
fn a_uniform_path_leaves_no_point_farther_than_its_pitch() {
    let disc = |x: f64, y: f64| (x - 20.0).hypot(y - 20.0);
    let rectangle = map([40.0, 25.0], 0.25, |_, _| 1.0);
    let circle = map([40.0, 40.0], 0.25, |x, y| only(disc(x, y) <= 20.0));
    let ring = map([40.0, 40.0], 0.25, |x, y| only((8.0..20.0).contains(&disc(x, y))));
    for surface in [rectangle, circle, ring] {
        for construction in BOTH {
            for seed in 0..2 {
                let settings =
                    RandomAdaptiveSettings { seed, contrast: 0.0, ..settings(construction) };
                let made = make(&surface, &settings);
                let coverage = statistics(&made.path, &surface).coverage_mm.unwrap();
                assert!(coverage <= settings.pitch_mm, "{construction:?} {seed}: {coverage}");
                assert_eq!((crossings(&made.path), lifts(&made.path)), (0, 0));
            }
        }
    }
}

#[test]
fn the_path_goes_around_a_hole_and_lifts_between_islands() {
    let hole = |x: f64, y: f64| (x - 15.0).abs() < 6.0 && (y - 10.0).abs() < 5.0;
    let islands = |x: f64, _: f64| !(10.0..18.0).contains(&x) && x != 25.0;
    let holed = map([30.0, 20.0], 0.5, |x, y| only(!hole(x, y)));
    let apart = map([40.0, 20.0], 0.5, |x, y| only(islands(x, y)));
    for construction in BOTH {
        let path = make(&holed, &settings(construction)).path;
        assert_eq!(crossings(&path), 0);
        // A tour may have to jump over the hole, but not with the tool on.
        assert!(construction == Construction::Tour || lifts(&path) == 0);
        // The hole less the overscan, and a spacing for the corners that are cut.
        let deep = |p: &[f64; 2]| (p[0] - 15.0).abs() < 3.0 && (p[1] - 10.0).abs() < 2.0;
        let worked = path.dwell_point_mm().iter().zip(path.tool_on()).filter(|(_, on)| **on);
        assert!(!worked.map(|(p, _)| p).any(deep));

        // Two islands; the column of dropouts at x = 25 is bridged.
        let made = make(&apart, &settings(construction));
        assert_eq!((made.report.islands, lifts(&made.path)), (2, 1));
        assert_eq!((made.path.pass_idx()[0], made.path.pass_idx()[made.path.len() - 1]), (0, 1));
        assert!(is_closed(&made.path));
    }
}

#[test]
fn a_tiny_island_has_its_own_small_loop() {
    let surface = map([40.0, 20.0], 0.5, |x, y| only(x < 20.0 || (x == 35.0 && y == 10.0)));
    for construction in BOTH {
        let settings = RandomAdaptiveSettings { overscan_mm: 0.0, ..settings(construction) };
        let made = make(&surface, &settings);
        assert_eq!(made.report.islands, 2);
        let coverage = statistics(&made.path, &surface).coverage_mm.unwrap();
        // A uniform map: the pitch.
        assert!(coverage <= 1.0, "{coverage}");
    }
}

#[test]
fn more_rounding_turns_less_at_a_time() {
    let surface = map([30.0, 30.0], 0.5, |_, _| 1.0);
    let mean_turn = |rounding_passes| {
        let settings =
            RandomAdaptiveSettings { rounding_passes, ..settings(Construction::MeshTree) };
        let path = make(&surface, &settings).path;
        let d: Vec<[f64; 2]> = (0..path.len()).map(|i| path.displacement_mm(i)).collect();
        let turn = |w: &[[f64; 2]]| {
            let (a, b) = (w[0], w[1]);
            (a[0] * b[1] - a[1] * b[0]).atan2(a[0] * b[0] + a[1] * b[1]).abs().to_degrees()
        };
        d.windows(2).map(turn).sum::<f64>() / (d.len() - 1) as f64
    };
    let turns = [0, 1, 2].map(mean_turn);
    // Every corner becomes two that share its angle.
    assert!((turns[0] / turns[1] - 2.0).abs() < 0.2, "{turns:?}");
    // As above.
    assert!((turns[1] / turns[2] - 2.0).abs() < 0.2, "{turns:?}");
}

#[test]
fn no_path_works_in_a_hole() {
    // Rings around holes with a notch, which a step of the tour could pass; and the same in the
    // middle of little removal, where triangles of 5 mm are wider than the notch of 1.6 mm.
    let mut off = [0, 0];
    for (k, hole) in [2.0, 3.0, 4.0, 5.0, 6.0, 1.8, 2.2, 2.5, 2.8, 3.2].into_iter().enumerate() {
        let wide = k >= 5;
        let surface = map([30.0, 30.0], 0.25, |x, y| {
            let r = (x - 15.0).hypot(y - 15.0);
            let notch = x > 15.0 && (y - 15.0).abs() < if wide { 0.8 } else { 1.2 };
            match r >= hole && r <= 14.0 && !notch {
                true if wide && r < 11.0 => 0.1,
                true => 1.0,
                false => f64::NAN,
            }
        });
        for (construction, off) in BOTH.into_iter().zip(&mut off) {
            let settings = RandomAdaptiveSettings {
                overscan_mm: 0.0,
                rounding_passes: 0,
                seed: k as u64,
                ..settings(construction)
            };
            let made = make(&surface, &settings);
            *off += made.report.steps_off;
            let path = made.path;
            let worst = (0..path.len()).filter(|i| path.tool_on()[*i]).map(|i| {
                let (a, d) = (path.point_mm()[i], path.displacement_mm(i));
                let inward = (0..=20).map(|k| {
                    let f = f64::from(k) / 20.0;
                    hole - (a[0] + f * d[0] - 15.0).hypot(a[1] + f * d[1] - 15.0)
                });
                inward.fold(f64::MIN, f64::max)
            });
            // Half a pitch of region beyond the aperture, and two cells and one of a third of a
            // pitch, diagonally.
            let worst = worst.fold(f64::MIN, f64::max);
            assert!(worst < 1.5 * 2.0_f64.sqrt(), "{construction:?}, {hole} mm: {worst} mm");
            let covered = statistics(&path, &surface).coverage_mm.unwrap();
            let most = 1.5 * made.report.largest_spacing_mm;
            assert!(covered < most, "{construction:?}, {hole} mm: {covered}");
        }
    }
    // Both would have.
    assert!(off.iter().all(|n| *n > 0), "{off:?}");
}

proptest! {
    // Each case makes two paths of some thousand steps: few, unless PROPTEST_CASES says otherwise.
    #![proptest_config(match std::env::var_os("PROPTEST_CASES") {
        Some(_) => ProptestConfig::default(),
        None => ProptestConfig::with_cases(6),
    })]

    #[test]
    fn what_is_promised_holds_on_random_masks(
        discs in prop::collection::vec((0.0..40.0_f64, 0.0..30.0_f64, 2.0..9.0_f64), 2..8),
        hole in (0.0..40.0_f64, 0.0..30.0_f64, 0.0..5.0_f64),
        pixel in 0.2..1.0_f64,
        pitch_mm in 0.6..1.2_f64,
        overscan_mm in prop_oneof![Just(0.0), 0.0..4.0_f64],
        step in 0.5..3.0_f64,
        divided in any::<bool>(),
        contrast in 0.0..=1.0_f64,
        rounding_passes in 0..3_u32,
        seed in any::<u64>(),
    ) {
        let inside = |x: f64, y: f64, d: (f64, f64, f64)| (x - d.0).hypot(y - d.1) <= d.2;
        let surface = map([40.0, 30.0], pixel, |x, y| {
            let valid = discs.iter().any(|d| inside(x, y, *d)) && !inside(x, y, hole);
            if valid { 2.0 + (0.2 * x).sin() + (0.3 * y).cos() } else { f64::NAN }
        });
        for construction in BOTH {
            let settings = RandomAdaptiveSettings {
                pitch_mm,
                overscan_mm,
                step_mm: divided.then_some(step * pitch_mm),
                contrast,
                construction,
                rounding_passes,
                seed,
            };
            let made = match random_adaptive(&surface, &settings) {
                Ok(made) => made,
                // A hole can leave next to nothing.
                Err(e) => {
                    prop_assert!(e.to_string().contains("largest island"), "{e}");
                    continue;
                }
            };
            let (path, report) = (&made.path, &made.report);
            prop_assert_eq!(crossings(path), 0);
            if construction == Construction::MeshTree && report.steps_off == 0 {
                prop_assert_eq!(lifts(path) + 1, report.islands);
            }
            prop_assert!(lifts(path) + 1 >= report.islands);
            prop_assert!(report.steps_off > 0 || is_closed(path));
            prop_assert!(report.longest_step_per_spacing <= 3.0, "{:?}", report);
            let numbers = statistics(path, &surface);
            prop_assert_eq!(numbers.crossings, 0);
            if rounding_passes > 0 && !divided && report.corners_kept == 0 {
                // Rounding of atan2.
                let turn_deg = numbers.largest_turn_deg;
                prop_assert!(turn_deg <= 90.0 + 1e-6, "{turn_deg}");
            }
            let coverage = numbers.coverage_mm.unwrap();
            // Corners of the region and the smoothed border cost up to half a spacing.
            prop_assert!(coverage <= 1.5 * report.largest_spacing_mm, "{coverage} {:?}", report);
        }
    }
}

/// Runs `random-adaptive --surface surface` with `arguments`; returns the exit code and the printed text.
fn run(dir: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let surface = dir.join("surface");
    let axis = |n| Array1::from_iter((0..n).map(|i| 0.5 * f64::from(i))).into_dyn();
    save(&surface, "height_nm", Array2::from_elem((21, 41), 1.0));
    save(&surface, "x_mm", axis(41));
    save(&surface, "y_mm", axis(21));
    let output = planish_testkit::program::stage("planish-toolpath")
        .current_dir(dir)
        .args(["random-adaptive", "--surface", "surface", "--out", "out"])
        .args(arguments)
        .output()
        .unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn the_binary_writes_a_path_and_its_numbers() {
    let tmp = tempfile::tempdir().unwrap();
    let flags = "--pitch-mm 1 --overscan-mm 1 --step-mm 0.8 --seed 5 --contrast 0.5 \
                 --construction tour --rounding-passes 2";
    let (code, said) = run(tmp.path(), &flags.split_whitespace().collect::<Vec<_>>());
    assert_eq!(code, Some(0), "{said}");
    let loaded = artifact::read::<ToolPath>(&tmp.path().join("out")).unwrap();
    let manifest = loaded.manifest.unwrap();
    let s = &manifest.settings;
    assert_eq!((&s["seed"], &s["contrast"], &s["step_mm"]), (&5.into(), &0.5.into(), &0.8.into()));
    assert_eq!((&s["construction"], &s["rounding_passes"]), (&"tour".into(), &2.into()));
    let o = &manifest.outcome;
    assert_eq!((&o["lifts"], &o["islands"], &o["crossings"]), (&0.into(), &1.into(), &0.into()));
    // Regression bound: 0.81 was seen.
    assert!(o["longest_step_per_spacing"].as_f64().unwrap() <= 3.0, "{o}");
    assert_eq!(loaded.value.point_mm()[0], loaded.value.point_mm()[loaded.value.len()]);
}

#[test]
fn bad_input_ends_with_2_a_message_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    let cases = [
        ("--pitch-mm 1", "--tif"),
        ("--pitch-mm 0 --overscan-mm 1", "pitch_mm: is 0"),
        ("--pitch-mm NaN --overscan-mm 1", "pitch_mm: is NaN"),
        ("--pitch-mm 1 --overscan-mm -100", "which leaves nothing of the aperture"),
        ("--pitch-mm 1 --overscan-mm 1 --step-mm 0", "step_mm: is 0"),
        ("--pitch-mm 1 --overscan-mm 1 --contrast 1.5", "contrast: is 1.5"),
        ("--pitch-mm 1 --overscan-mm 1 --rounding-passes 9", "rounding_passes: is 9"),
        ("--pitch-mm 30 --overscan-mm 1", "largest island of the region"),
        ("--pitch-mm 1e-4 --overscan-mm 1", "too fine"),
        ("--pitch-mm 1 --overscan-mm 1 --construction spiral", "invalid value"),
    ];
    for (arguments, message) in cases {
        let (code, said) = run(tmp.path(), &arguments.split_whitespace().collect::<Vec<_>>());
        assert_eq!(code, Some(2), "{arguments}: {said}");
        assert!(said.contains(message), "{arguments}: {said}");
        assert!(!tmp.path().join("out").exists(), "{arguments}");
    }
}
