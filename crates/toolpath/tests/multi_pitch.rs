//! The multi-pitch raster: what is promised of it, over shapes, depths and settings.

use std::{collections::BTreeMap, path::Path, process::Output};

use ndarray::{Array1, Array2};
use planish_handoff::artifact;
use planish_testkit::{maps::random_aperture, program::save};
use planish_toolpath::{
    MultiPitch, MultiPitchSettings, RasterSettings, multi_pitch,
    multi_pitch::{Links, class_pitches_mm},
    raster, statistics,
};
use planish_types::{Axis, Grid, Surface, Tif, ToolPath};
use proptest::prelude::*;

/// Makes a map with pixels of `pixel` mm; `depth(x, y)` is NaN outside.
fn map(size: [f64; 2], pixel: f64, depth: impl Fn(f64, f64) -> f64) -> Surface {
    let [x, y] = size.map(|s| Axis::new(0.0, pixel, (s / pixel).round() as usize + 1).unwrap());
    let height = Array2::from_shape_fn((y.len(), x.len()), |(r, c)| {
        depth(x.coordinate_mm(c), y.coordinate_mm(r))
    });
    Surface::new(Grid { x, y }, height).unwrap()
}

/// Makes a Gaussian TIF of standard deviation `sigma` mm, 12 sigma wide, with the VRR 2 pi sigma^2.
fn tif(sigma: f64) -> Tif {
    let axis = Axis::new(-6.0 * sigma, 0.1 * sigma, 121).unwrap();
    let g = |d: f64| (-0.5 * (d / sigma).powi(2)).exp();
    let rate = Array2::from_shape_fn((121, 121), |(r, c)| {
        g(axis.coordinate_mm(r)) * g(axis.coordinate_mm(c))
    });
    Tif::new(Grid { x: axis, y: axis }, rate).unwrap()
}

fn settings(classes: usize, max_velocity_mm_per_s: f64) -> MultiPitchSettings {
    MultiPitchSettings {
        classes,
        max_velocity_mm_per_s,
        min_pitch_mm: 0.1,
        max_pitch_mm: 2.0,
        min_area_mm2: None,
        step_mm: 1.0,
        overscan_mm: 3.0,
        links: Links::On,
    }
}

/// Returns the length of the lines (segments along x) of every region, mm.
fn line_length_mm(made: &MultiPitch) -> Vec<f64> {
    let mut length = vec![0.0; made.report.regions.len()];
    for i in 0..made.path.len() {
        let [dx, dy] = made.path.displacement_mm(i);
        if made.path.tool_on()[i] && dy == 0.0 {
            length[made.path.pass_idx()[i] as usize] += dx.abs();
        }
    }
    length
}

/// Returns the number of pairs of lines that coincide to 1e-9 mm.
fn coincident(path: &ToolPath) -> usize {
    let mut by_line: BTreeMap<i64, Vec<[f64; 2]>> = BTreeMap::new();
    for (i, p) in path.point_mm().windows(2).enumerate() {
        if path.tool_on()[i] && p[0][1] == p[1][1] {
            let key = (p[0][1] * 1e9).round() as i64;
            by_line.entry(key).or_default().push([p[0][0].min(p[1][0]), p[0][0].max(p[1][0])]);
        }
    }
    let pairs = by_line.values_mut().map(|line| {
        line.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]));
        line.windows(2).filter(|w| w[1][0] < w[0][1] - 1e-9).count()
    });
    pairs.sum()
}

#[test]
fn the_pitches_of_the_paper_come_from_the_middles_of_its_bands() {
    // VRR / v = 50.6 nm mm. Its pitches 0.80, 0.40, 0.20, 0.133 mm belong to the depths 63.3,
    // 126.6, 253 and 380 nm: lower edges of four equal classes up to 506.3 nm.
    let equal = [0.0, 126.6, 253.2, 379.8, 506.4];
    let found = class_pitches_mm(&equal, 50.6, [0.05, 5.0]);
    for (d, printed) in found.iter().zip([0.80, 0.40, 0.20, 0.133]) {
        // Three digits are printed.
        assert!((d - printed).abs() < 0.001, "{found:?}");
    }
    // With its own bands (widths 63.3 and 3 x 126.6 nm) the lower edges give these, at which no
    // depth of the classes 2 to 4 needs more than v_max; its own pitches do, up to 2 times.
    let bands = [0.0, 63.3, 190.0, 316.0, 443.0];
    let ours = class_pitches_mm(&bands, 50.6, [0.05, 0.8]);
    let over = |d: &[f64]| (1..4).map(|k| 50.6 / (d[k] * bands[k])).fold(0.0, f64::max);
    for (d, expected) in ours.iter().zip([0.8, 50.6 / 63.3, 50.6 / 190.0, 50.6 / 316.0]) {
        // Below: rounding of quotients.
        assert!((d - expected).abs() < 1e-12, "{ours:?}");
    }
    assert!(over(&ours) <= 1.0 + 1e-12);
    // 126.6 / 63.3.
    assert!((over(&found) - 2.0).abs() < 0.001, "{}", over(&found));
}

#[test]
fn a_constant_map_is_one_region_and_the_uniform_raster() {
    let tif = tif(1.0);
    let vrr = tif.vrr_nm_mm2_per_s();
    for (depth, v) in [(0.0, 1.0), (10.0, vrr / 8.0)] {
        let surface = map([40.0, 21.0], 0.5, |_, _| depth);
        let made = multi_pitch(&surface, &tif, &settings(4, v)).unwrap();
        // d = VRR / (r v): the largest for no depth, 0.8 mm for 10 nm.
        let pitch_mm = if depth == 0.0 { 2.0 } else { 0.8 };
        assert_eq!((made.report.classes.len(), made.report.regions.len()), (1, 1));
        // Rounding of a quotient.
        assert!((made.report.classes[0].pitch_mm - pitch_mm).abs() < 1e-12);
        assert!(made.region_idx.iter().all(|i| *i == 0));
        let uniform = RasterSettings::new(made.report.classes[0].pitch_mm, 1.0, 3.0);
        let uniform = raster(&surface, &uniform).unwrap();
        assert_eq!(made.path.tool_on(), uniform.tool_on());
        for (a, b) in made.path.point_mm().iter().zip(uniform.point_mm()) {
            // Rounding of coordinates up to 43 mm.
            assert!((a[0] - b[0]).abs() < 1e-12 && (a[1] - b[1]).abs() < 1e-12, "{a:?} {b:?}");
        }
    }
}

#[test]
fn a_ramp_has_a_class_after_the_other_none_too_fast() {
    // 0 to 100 nm over 100 mm; the TIF smooths over 0.3 mm only.
    let tif = tif(0.5);
    let vrr = tif.vrr_nm_mm2_per_s();
    let surface = map([100.0, 40.0], 0.5, |x, _| x);
    let wide = MultiPitchSettings { max_pitch_mm: 10.0, ..settings(5, vrr / 20.0) };
    let made = multi_pitch(&surface, &tif, &wide).unwrap();
    // Lower edges 10 (half the first class), 20, 40, 60, 80 nm, but for the smoothed ends.
    let classes = &made.report.classes;
    for (k, (c, d)) in classes.iter().zip([2.0, 1.0, 0.5, 1.0 / 3.0, 0.25]).enumerate() {
        assert!((c.pitch_mm / d - 1.0).abs() < 0.02, "{k}: {c:?}");
        assert_eq!(c.components, 1);
        // v = VRR / (d r), at most v_max from r_k upwards.
        let fastest = vrr / (c.pitch_mm * c.edge_nm[0].max(0.5 * classes[0].edge_nm[1]));
        // The pitch is off by 2 %, as above, and the edges of the smoothed map by less.
        assert!(fastest <= wide.max_velocity_mm_per_s * 1.03, "{fastest}");
        assert!(k == 0 || c.too_fast_mm2 == 0.0, "{c:?}");
        // Pixels of 0.5 mm at the two borders of 20 mm: 5 %.
        assert!((c.area_mm2 / (20.0 * 40.5) - 1.0).abs() < 0.05, "{c:?}");
    }
    assert_eq!(classes.len(), 5);
    // Below r_1 the first class is too fast: half of it.
    assert!((classes[0].too_fast_mm2 / classes[0].area_mm2 - 0.5).abs() < 0.05);
    assert_eq!(statistics(&made.path, &surface).lifts, 4);
}

#[test]
fn borders_have_neither_gaps_nor_double_lines() {
    // Two halves of equal height: every line of one ends where those of the other begin.
    let tif = tif(0.5);
    let vrr = tif.vrr_nm_mm2_per_s();
    let surface = map([60.0, 30.0], 0.5, |x, _| if x < 30.0 { 20.0 } else { 80.0 });
    let settings = MultiPitchSettings { overscan_mm: 2.5, ..settings(2, vrr / 50.0) };
    let made = multi_pitch(&surface, &tif, &settings).unwrap();
    let pitches: Vec<f64> =
        made.report.regions.iter().map(|r| made.report.classes[r.class].pitch_mm).collect();
    assert_eq!(pitches.len(), 2);
    // From 20 and 50 nm: 2 (the largest) and 1 mm over 35 mm: 18 and 36 lines, one border.
    let left = usize::from(pitches[1] > pitches[0]);
    let expected = [(left, 18.0, 2.0, 29.75 + 2.5), (1 - left, 36.0, 1.0, 62.5 - 29.75)];
    for (region, count, pitch, width) in expected {
        // The smoothed step ends within 1e-6 of its heights.
        assert!((pitches[region] - pitch).abs() < 1e-6, "{pitches:?}");
        let length = line_length_mm(&made)[region];
        // Rounding of a sum of 36 lengths.
        assert!((length - count * width).abs() < 1e-9, "{length}");
    }
    let ends = |pass: i64, pick: fn(f64, f64) -> f64, start: f64| {
        let segments = (0..made.path.len())
            .filter(|i| made.path.tool_on()[*i] && made.path.pass_idx()[*i] == pass);
        segments
            .flat_map(|i| [made.path.point_mm()[i][0], made.path.point_mm()[i + 1][0]])
            .fold(start, pick)
    };
    let border = [ends(left as i64, f64::max, f64::MIN), ends(1 - left as i64, f64::min, f64::MAX)];
    // Rounding of 29.75.
    assert!((border[0] - border[1]).abs() < 1e-12, "{border:?}");
    // All lines of both end there: none is short of it.
    let reach = (0..made.path.len()).filter(|i| {
        let (a, b) = (made.path.point_mm()[*i], made.path.point_mm()[i + 1]);
        made.path.tool_on()[*i] && a[1] == b[1] && border.iter().any(|x| a[0] == *x || b[0] == *x)
    });
    assert_eq!(reach.count(), 18 + 36);
    assert_eq!(statistics(&made.path, &surface).lifts, 1);
}

#[test]
fn no_line_reaches_into_the_region_beside_it() {
    // An overscan of 1.79 pixels of 0.5 mm, and a pixel alone beside a half disc. The line at 3.75
    // mm lies between two rows: both regions have it, one used to run it past its last pixel.
    let first = [5, 4, 4, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 4, 4, 5].map(|c| 0.5 * f64::from(c));
    let surface = map([3.5, 7.5], 0.5, |x, y| {
        let alone = (x, y) == (0.0, 4.5);
        if alone || x >= first[(2.0 * y) as usize] { 50.0 } else { f64::NAN }
    });
    let settings = MultiPitchSettings {
        overscan_mm: 0.897,
        min_pitch_mm: 0.3,
        max_pitch_mm: 0.4,
        step_mm: 0.3,
        ..settings(1, 0.4 * std::f64::consts::PI)
    };
    let made = multi_pitch(&surface, &tif(1.0), &settings).unwrap();
    assert_eq!((made.report.regions.len(), coincident(&made.path)), (2, 0));
}

#[test]
fn the_tool_is_lifted_along_borders_or_on_every_link() {
    // Shallow on the left, deep on the right of a wavy border.
    let surface =
        map([40.0, 30.0], 0.25, |x, y| if x < 20.0 + (0.4 * y).sin() { 20.0 } else { 100.0 });
    let tif = tif(1.0);
    let with = |links| {
        let settings = MultiPitchSettings { links, ..settings(2, tif.vrr_nm_mm2_per_s() / 20.0) };
        multi_pitch(&surface, &tif, &settings).unwrap()
    };
    let made = [Links::On, Links::Outside, Links::Off].map(with);
    // Links with the tool on: beside the border inside the part, and beyond the part.
    let links = made.each_ref().map(|made| {
        let path = &made.path;
        // A line may begin where the one before it ended, to rounding.
        let across = |i: &usize| path.displacement_mm(*i)[1].abs() > 1e-6;
        let on = (0..path.len()).filter(|i| path.tool_on()[*i]).filter(across);
        let inside = |i: &usize| (1.0..39.0).contains(&path.dwell_point_mm()[*i][0]);
        let (inner, outer): (Vec<usize>, Vec<usize>) = on.partition(inside);
        [inner.len(), outer.len()]
    });
    let [on, outside, off] = links;
    // Both regions have a link at every other end of their lines: 30 mm in pitches of up to 2 mm.
    assert!(on[0] > 20 && on[1] > 20, "{links:?}");
    assert_eq!((outside, off), ([0, on[1]], [0, 0]));
    // The lines are the same, and so is where they are.
    let [a, b, c] = made.each_ref().map(|m| line_length_mm(m).iter().sum::<f64>());
    // Rounding of a sum of some ten lengths.
    assert!((a / b - 1.0).abs() < 1e-12 && (a / c - 1.0).abs() < 1e-12, "{a} {b} {c}");
    assert!(made[1..].iter().all(|m| m.region_idx == made[0].region_idx));
}

#[test]
fn the_area_of_the_lines_is_that_of_the_regions() {
    let tif = tif(1.0);
    let vrr = tif.vrr_nm_mm2_per_s();
    let bowl = |x: f64, y: f64| 0.1 * ((x - 30.0).powi(2) + (y - 25.0).powi(2));
    let surface = map([60.0, 50.0], 0.25, bowl);
    let made = multi_pitch(&surface, &tif, &settings(4, vrr / 20.0)).unwrap();
    let total: f64 = line_length_mm(&made)
        .iter()
        .zip(&made.report.regions)
        .map(|(l, r)| l * made.report.classes[r.class].pitch_mm)
        .sum();
    // 66 x 56 mm, and half a pitch of at most 2 mm on four sides.
    assert!((total / (66.0 * 56.0) - 1.0).abs() < 0.04, "{total}");
    let s = statistics(&made.path, &surface);
    let cells: usize = made.report.regions.iter().map(|r| r.cells).sum();
    assert_eq!((s.lifts < cells, s.passes), (true, made.report.regions.len()));
    let pitches: Vec<f64> = made.report.classes.iter().map(|c| c.pitch_mm).collect();
    assert!(pitches.windows(2).all(|w| w[1] < w[0]), "{pitches:?}");
}

#[test]
fn noise_leaves_no_small_region() {
    let tif = tif(1.0);
    let vrr = tif.vrr_nm_mm2_per_s();
    // A ramp with a pattern that crosses every class edge many times.
    let noisy = |x: f64, y: f64| 40.0 + x + 6.0 * (2.1 * x).sin() * (1.7 * y).cos();
    let surface = map([80.0, 60.0], 0.5, noisy);
    let none = MultiPitchSettings { min_area_mm2: Some(0.0), ..settings(4, vrr / 50.0) };
    let raw = multi_pitch(&surface, &tif, &none).unwrap().report.regions.len();
    let least = MultiPitchSettings { min_area_mm2: Some(60.0), ..none };
    let made = multi_pitch(&surface, &tif, &least).unwrap();
    assert!(raw > 2 * made.report.regions.len(), "{raw} {}", made.report.regions.len());
    // Below: rounding of areas, which are sums of pixels.
    assert!(made.report.regions.iter().all(|r| r.area_mm2 >= 60.0 * (1.0 - 1e-9)));
    let area: f64 = made.report.classes.iter().map(|c| c.area_mm2).sum();
    assert!((area - 161.0 * 121.0 * 0.25).abs() < 1e-6, "{area}");
}

#[test]
fn bad_settings_are_refused_with_the_value() {
    let tif = tif(1.0);
    let surface = map([20.0, 10.0], 0.5, |x, _| x);
    let good = settings(3, 1.0);
    let cases = [
        (MultiPitchSettings { classes: 0, ..good.clone() }, "classes: is 0"),
        (MultiPitchSettings { classes: usize::MAX, ..good.clone() }, "give 1 to 100"),
        (
            MultiPitchSettings { max_velocity_mm_per_s: 0.0, ..good.clone() },
            "max_velocity_mm_per_s: is 0",
        ),
        (
            MultiPitchSettings { max_velocity_mm_per_s: f64::NAN, ..good.clone() },
            "max_velocity_mm_per_s: is NaN",
        ),
        (MultiPitchSettings { min_pitch_mm: 3.0, ..good.clone() }, "above the largest pitch"),
        (MultiPitchSettings { min_pitch_mm: 0.0, ..good.clone() }, "min_pitch_mm: is 0"),
        (MultiPitchSettings { max_pitch_mm: -1.0, ..good.clone() }, "max_pitch_mm: is -1"),
        (MultiPitchSettings { step_mm: f64::NAN, ..good.clone() }, "step_mm: is NaN"),
        (MultiPitchSettings { overscan_mm: -1.0, ..good.clone() }, "overscan_mm: is -1"),
        (MultiPitchSettings { min_area_mm2: Some(-1.0), ..good.clone() }, "min_area_mm2: is -1"),
        (
            MultiPitchSettings { max_pitch_mm: 50.0, max_velocity_mm_per_s: 1e-3, ..good.clone() },
            "larger than the aperture, 10.5 mm",
        ),
        (MultiPitchSettings { overscan_mm: 1e6, ..good.clone() }, "more than 20000000"),
        (MultiPitchSettings { step_mm: 1e-7, ..good.clone() }, "more than 20000000"),
        (
            MultiPitchSettings { min_pitch_mm: 1e-9, max_pitch_mm: 1e-9, ..good.clone() },
            "more than 20000000",
        ),
    ];
    for (settings, message) in cases {
        let error = multi_pitch(&surface, &tif, &settings).unwrap_err().to_string();
        assert!(error.contains(message), "{message}: {error}");
    }
}

prop_compose! {
    /// Waves of depth within a random aperture.
    fn random_map()(
        aperture in random_aperture(8..50),
        waves in (0.0..1.5_f64, 0.0..1.5_f64, 0.0..50.0_f64),
    ) -> Surface {
        let g = *aperture.grid();
        let mut height = aperture.height_nm().clone();
        for ((r, c), z) in height.indexed_iter_mut().filter(|(_, z)| !z.is_nan()) {
            *z = 50.0 + waves.2 * (waves.0 * g.x.coordinate_mm(c)).sin() * (waves.1 * g.y.coordinate_mm(r)).cos();
        }
        Surface::new(g, height).unwrap()
    }
}

prop_compose! {
    fn random_settings()(
        classes in 1..6_usize,
        slow in 5.0..100.0_f64,
        max_pitch_mm in 0.4..2.0_f64,
        min_area_mm2 in prop_oneof![Just(None), Just(Some(0.0)), (0.0..30.0_f64).prop_map(Some)],
        step_mm in 0.3..3.0_f64,
        overscan_mm in prop_oneof![Just(0.0), 0.0..3.0_f64],
        links in prop_oneof![Just(Links::On), Just(Links::Outside), Just(Links::Off)],
    ) -> MultiPitchSettings {
        MultiPitchSettings {
            classes,
            max_velocity_mm_per_s: 2.0 * std::f64::consts::PI / slow,
            min_pitch_mm: 0.3,
            max_pitch_mm,
            min_area_mm2,
            step_mm,
            overscan_mm,
            links,
        }
    }
}

proptest! {
    #[test]
    fn what_holds_for_every_aperture(surface in random_map(), settings in random_settings()) {
        let tif = tif(1.0);
        let made = match multi_pitch(&surface, &tif, &settings) {
            Ok(made) => made,
            Err(e) => {
                prop_assert!(e.to_string().contains("larger than the aperture"), "{e}");
                return Ok(());
            }
        };
        let (path, report) = (&made.path, &made.report);
        // Every pixel is in one region, a region has one class, no area is lost.
        let mut pixels = vec![0; report.regions.len()];
        for (z, i) in surface.height_nm().iter().zip(&made.region_idx) {
            prop_assert_eq!(z.is_nan(), *i < 0);
            if *i >= 0 {
                pixels[*i as usize] += 1;
            }
        }
        for (count, region) in pixels.iter().zip(&report.regions) {
            prop_assert!((f64::from(*count) * 0.25 - region.area_mm2).abs() < 1e-9);
            prop_assert!(*count > 0 && region.cells > 0);
        }
        prop_assert!(report.classes.windows(2).all(|w| w[1].pitch_mm < w[0].pitch_mm));
        // The path: lengths, steps, regions in order, lifts between tool-on stretches.
        let (on, pass) = (path.tool_on(), path.pass_idx());
        for i in 0..path.len() {
            let length = path.segment_length_mm(i);
            prop_assert!(length > 1e-9, "segment {i} has the length {length}");
            prop_assert!(!on[i] || length <= settings.step_mm * (1.0 + 1e-9), "{i}: {length}");
            let next = (i + 1 < path.len()).then(|| pass[i + 1]);
            prop_assert!(next.is_none_or(|n| n == pass[i] || n == pass[i] + 1));
            prop_assert!(on[i] || (i > 0 && on[i - 1] && i + 1 < path.len() && on[i + 1]));
        }
        prop_assert_eq!(pass[0], 0);
        prop_assert_eq!(pass[path.len() - 1] as usize + 1, report.regions.len());
        prop_assert_eq!(coincident(path), 0);
        // Every pixel is at most its own pitch from the path.
        let s = statistics(path, &surface);
        prop_assert!(s.coverage_mm.unwrap() <= report.classes[0].pitch_mm * (1.0 + 1e-8));
        for (index, class) in report.classes.iter().enumerate() {
            let own = Array2::from_shape_fn(made.region_idx.dim(), |at| {
                let i = made.region_idx[at];
                let is = i >= 0 && report.regions[i as usize].class == index;
                if is { 0.0 } else { f64::NAN }
            });
            if let Ok(own) = Surface::new(*surface.grid(), own) {
                let far = statistics(path, &own).coverage_mm.unwrap();
                prop_assert!(far <= class.pitch_mm * (1.0 + 1e-8), "{index}: {far} {class:?}");
            }
        }
        // One region alone never meets its own track.
        prop_assert!(report.regions.len() > 1 || s.crossings == 0, "{}", s.crossings);
        prop_assert_eq!(&multi_pitch(&surface, &tif, &settings).unwrap(), &made);
    }
}

/// Writes the inputs: a ramp of 40 nm over 40 mm, and the Gaussian TIF.
fn write_inputs(dir: &Path) {
    let surface = map([40.0, 20.0], 0.5, |x, _| x);
    save(&dir.join("surface"), "height_nm", surface.height_nm().clone());
    let tif = tif(1.0);
    save(&dir.join("tif"), "rate_nm_per_s", tif.rate_nm_per_s().clone());
    for (name, grid) in [("surface", surface.grid()), ("tif", tif.grid())] {
        save(&dir.join(name), "x_mm", Array1::from(grid.x.coordinates()));
        save(&dir.join(name), "y_mm", Array1::from(grid.y.coordinates()));
    }
}

fn call(dir: &Path, flags: &[&str]) -> Output {
    let common = ["multi-pitch", "--surface", "surface", "--tif", "tif", "--step-mm", "1"];
    planish_testkit::program::stage("planish-toolpath")
        .current_dir(dir)
        .args(common)
        .args(flags)
        .output()
        .unwrap()
}

#[test]
fn the_program_reports_classes_regions_and_feeds() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let flags = ["--max-velocity-mm-per-s", "0.4", "--classes", "3", "--out", "out"];
    let output = call(tmp.path(), &flags);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let loaded = artifact::read::<ToolPath>(&tmp.path().join("out")).unwrap();
    let manifest = loaded.manifest.unwrap();
    // The defaults: sqrt(2 pi^2 / ln 4000) sigma, less than a sixth of 12 mm. The TIF ends at 6 sigma, 1e-7 of it is
    // missing. Of a Gaussian 1 - erf(a / 2^1/2 sigma)^2 = 5e-4 is beyond the square of half size a = 3.66 sigma, on
    // samples of 0.1 sigma.
    let settings = &manifest.settings;
    let limit_mm = (2.0 * std::f64::consts::PI.powi(2) / 4000.0_f64.ln()).sqrt();
    let found_mm = settings["max_pitch_mm"].as_f64().unwrap();
    assert!((found_mm - limit_mm).abs() < 1e-6, "{found_mm}");
    assert!((settings["overscan_mm"].as_f64().unwrap() - 3.66).abs() < 0.1, "{settings}");
    let o = &manifest.outcome;
    let classes = o["classes"].as_array().unwrap();
    // VRR / v = 15.7 nm mm; lower edges 6.7, 13.3 and 26.7 nm: 1.54 (clamped), 1.18, 0.59 mm.
    for (class, pitch) in classes.iter().zip([1.543, 1.178, 0.589]) {
        // The smoothed map shifts the edges a little. Regression bound: 0.8 % was seen.
        assert!((class["pitch_mm"].as_f64().unwrap() / pitch - 1.0).abs() < 0.03, "{class}");
    }
    assert_eq!((classes.len(), o["regions"].as_array().unwrap().len()), (3, 3));
    assert_eq!((&o["passes"], &o["lifts"]), (&3.into(), &2.into()));
    assert!(o["lift_length_mm"].as_f64().unwrap() > 0.0);
    assert_eq!(o["warnings"].as_array().unwrap().len(), 0, "{o}");
    let again = call(tmp.path(), &flags);
    assert!(String::from_utf8(again.stdout).unwrap().contains("unchanged"));
    // A largest pitch too small for the feed.
    let small = ["--max-velocity-mm-per-s", "0.4", "--max-pitch-mm", "0.3", "--classes", "4"];
    let output = call(tmp.path(), &[&small[..], &["--min-pitch-mm", "0.3", "--out", "b"]].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
}

#[test]
fn bad_input_ends_with_2_a_message_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let cases: [(&[&str], &str); 7] = [
        (&[], "--max-velocity-mm-per-s"),
        (&["--max-velocity-mm-per-s", "0"], "max_velocity_mm_per_s: is 0"),
        (&["--max-velocity-mm-per-s", "-1"], "max_velocity_mm_per_s: is -1"),
        (&["--max-velocity-mm-per-s", "1", "--classes", "0"], "classes: is 0"),
        (&["--max-velocity-mm-per-s", "1", "--min-pitch-mm", "5"], "above the largest pitch"),
        (
            &["--max-velocity-mm-per-s", "0.001", "--max-pitch-mm", "100"],
            "larger than the aperture",
        ),
        (&["--max-velocity-mm-per-s", "1", "--min-area-mm2", "-2"], "min_area_mm2: is -2"),
    ];
    for (flags, message) in cases {
        let output = call(tmp.path(), &[flags, &["--out", "out"]].concat());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{flags:?}: {said}");
        assert!(said.contains(message), "{flags:?}: {said}");
        assert!(!tmp.path().join("out").exists(), "{flags:?}");
    }
}
