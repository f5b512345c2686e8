//! Maps in series: the mean with its standard deviations, and joined sub-apertures, against formulas.

use ndarray::{Array2, s};
use planish_register::{
    join::{Difference, JoinSettings, join},
    maps::MapSettings,
    series::{SeriesSettings, mean},
};
use planish_testkit::case_generator;
use planish_types::{Axis, Grid, Surface};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

const STILL: SeriesSettings = SeriesSettings { registration: None, free_order: 1 };

fn gaussian(random: &mut ChaCha8Rng) -> f64 {
    // Box and Muller
    let [u, v]: [f64; 2] = [random.random(), random.random()];
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

fn grid(start: [f64; 2], (ny, nx): (usize, usize)) -> Grid {
    let axis = |start: f64, n: usize| Axis::new(start, 0.2, n).unwrap();
    Grid { x: axis(start[0], nx), y: axis(start[1], ny) }
}

fn map(g: Grid, mut of: impl FnMut([f64; 2]) -> f64) -> Surface {
    let z =
        Array2::from_shape_fn(g.shape(), |(r, c)| of([g.x.coordinate_mm(c), g.y.coordinate_mm(r)]));
    Surface::new(g, z).unwrap()
}

/// Returns the height, nm, of smooth features at a point [x, y], mm; they extend over some pixels and never repeat.
fn features(p: [f64; 2]) -> f64 {
    let wave = |k: f64, l: f64, phase: f64| (k * p[0] + l * p[1] + phase).sin();
    4.0 * wave(1.1, 0.7, 0.2) * wave(-0.6, 1.7, 1.0)
        + 3.0 * wave(2.3, -1.3, 0.4)
        + 2.0 * wave(0.4, 2.9, 2.0) * wave(1.9, 0.3, 0.7)
}

#[test]
fn the_mean_and_its_deviation_are_those_of_the_formula() {
    let g = grid([0.0; 2], (40, 60));
    let random = &mut case_generator(55, 1, 0);
    // Mountings that differ by planes, and noise that grows along x.
    let maps: Vec<Surface> = (0..5)
        .map(|k| {
            let k = f64::from(k);
            map(g, |p| {
                let noise = (0.1 + 0.05 * p[0]) * gaussian(random);
                features(p) + noise + 3.0 * k - 0.7 * k * p[0] + 0.2 * k * k * p[1]
            })
        })
        .collect();
    let found = mean(&maps, &STILL).unwrap();
    // The formula, with planes by the normal equations in other coordinates.
    let plane = |d: &Array2<f64>| -> Array2<f64> {
        let (ny, nx) = d.dim();
        let u = |c: usize| c as f64 - (nx - 1) as f64 / 2.0;
        let v = |r: usize| r as f64 - (ny - 1) as f64 / 2.0;
        // On a full rectangle 1, u and v are orthogonal.
        let dot = |of: &dyn Fn(usize, usize) -> f64| -> f64 {
            let (mut a, mut b) = (0.0, 0.0);
            for ((r, c), z) in d.indexed_iter() {
                (a, b) = (a + of(r, c) * z, b + of(r, c) * of(r, c));
            }
            a / b
        };
        let (a, b, c) = (dot(&|_, _| 1.0), dot(&|_, c| u(c)), dot(&|r, _| v(r)));
        Array2::from_shape_fn(d.dim(), |(row, column)| a + b * u(column) + c * v(row))
    };
    let first = maps[0].height_nm();
    let level: Vec<Array2<f64>> =
        maps.iter().map(|m| m.height_nm() - &plane(&(m.height_nm() - first))).collect();
    let deviation = found.mean.deviation_nm().unwrap();
    for at in [(0, 0), (3, 50), (20, 31), (39, 59)] {
        let z: Vec<f64> = level.iter().map(|m| m[at]).collect();
        let m = z.iter().sum::<f64>() / 5.0;
        let s = (z.iter().map(|z| (z - m).powi(2)).sum::<f64>() / 4.0 / 5.0).sqrt();
        // Rounding of heights and planes of tens of nm.
        assert!((found.mean.height_nm()[at] - m).abs() < 1e-11, "{at:?}");
        assert!((deviation[at] - s).abs() < 1e-11, "{at:?}");
    }
    // The mean is the truth to its deviation: 2400 normal numbers scatter in RMS by 1 / sqrt(4800) = 1.4 %, three of it;
    // the planes take 3 of 2400 degrees of freedom.
    let truth = map(g, features);
    let left = found.mean.height_nm() - truth.height_nm();
    let left = &left - &plane(&left);
    let rms = (left.iter().map(|v| v * v).sum::<f64>() / 2400.0).sqrt();
    let report = &found.report;
    let ratio = rms / report.mean_deviation_nm;
    assert!((ratio - 1.0).abs() < 0.045, "{ratio}");
    // Pooled: mean of (0.1 + 0.05 x)^2 for x to 11.8.
    let want = (0..60).map(|c| (0.1 + 0.01 * f64::from(c)).powi(2)).sum::<f64>() / 60.0;
    // 9600 degrees of freedom know it to 0.7 %, and uneven noise to 1.2 times that: three of it.
    assert!((report.single_deviation_nm / want.sqrt() - 1.0).abs() < 0.03, "{report:?}");
    // The deviation grows with the noise.
    let of = |part: ndarray::ArrayView2<f64>| {
        (part.iter().map(|v| v * v).sum::<f64>() / part.len() as f64).sqrt()
    };
    let ends = of(deviation.slice(s![.., 50..])) / of(deviation.slice(s![.., ..10]));
    // 0.646 nm in the last ten columns over 0.148 nm in the first is 4.37. 1600 degrees of freedom know each to 1.8 %,
    // and the ratio to 2.5 %: eight of it.
    assert!((ends / 4.4 - 1.0).abs() < 0.2, "{ends}");
}

#[test]
fn moved_measurements_are_registered() {
    let g = grid([0.0; 2], (61, 101));
    let random = &mut case_generator(55, 2, 0);
    let centre = [10.0, 6.0];
    let poses: [[f64; 3]; 3] = [[0.0; 3], [0.31, -0.17, 4e-3], [-0.22, 0.4, -6e-3]];
    let maps: Vec<Surface> = poses
        .iter()
        .map(|[x, y, turn]| {
            let (sin, cos) = turn.sin_cos();
            map(g, |p| {
                let d = [p[0] - centre[0] - x, p[1] - centre[1] - y];
                let q = [centre[0] + cos * d[0] + sin * d[1], centre[1] - sin * d[0] + cos * d[1]];
                features(q) + 0.02 * gaussian(random)
            })
        })
        .collect();
    let registration = Some(MapSettings {
        most_shift_mm: 1.0,
        most_rotation_deg: 1.0,
        free_order: 1,
        shorter_than_mm: None,
    });
    let found = mean(&maps, &SeriesSettings { registration, free_order: 1 }).unwrap();
    for (member, pose) in found.report.members.iter().zip(&poses[1..]) {
        // Four standard errors, and what Keys' interpolation of waves of 2 mm at steps of 0.2 mm leaves: a hundredth of a
        // pixel, and as much at the corners, 11.7 mm from the middle.
        for (value, want, left) in [
            (member.shift_x_mm.unwrap(), pose[0], 2e-3),
            (member.shift_y_mm.unwrap(), pose[1], 2e-3),
            (member.rotation_deg.unwrap(), pose[2].to_degrees(), (2e-3_f64 / 11.7).to_degrees()),
        ] {
            let error = (value.value - want).abs();
            assert!(error < 4.0 * value.standard_error + left, "{value:?} {want}");
        }
    }
    // Without registration, displacements of two pixels are a hundred times the noise.
    let unregistered = mean(&maps, &STILL).unwrap().report.single_deviation_nm;
    // Regression bound: 0.018 nm was seen. The noise is 0.02 nm.
    assert!(found.report.single_deviation_nm < 0.06, "{:?}", found.report);
    // Regression bound: 2.35 nm was seen.
    assert!(unregistered > 1.0, "{unregistered}");
}

#[test]
fn a_pixel_of_one_map_is_no_mean() {
    let g = grid([0.0; 2], (10, 12));
    let mut holes = map(g, features).height_nm().clone();
    holes[[3, 4]] = f64::NAN;
    let holed = Surface::new(g, holes).unwrap();
    let maps = [map(g, features), holed.clone(), holed];
    let found = mean(&maps, &STILL).unwrap();
    assert!(found.mean.height_nm()[[3, 4]].is_nan());
    assert_eq!(found.report.pixels, 119);
    let message = mean(&maps[..1], &STILL).unwrap_err().to_string();
    assert!(message.contains("has 1 map(s)"), "{message}");
    let far = map(grid([50.0, 0.0], (10, 12)), features);
    let message = mean(&[maps[0].clone(), far], &STILL).unwrap_err().to_string();
    assert!(message.starts_with("map 2: map: has 0 valid pixel(s) in common"), "{message}");
}

/// Returns sub-aperture maps of one surface with different pistons, tilts and noise. Their pixels are pixels of the
/// whole.
fn mosaic(noise_nm: f64, random: &mut ChaCha8Rng) -> Vec<Surface> {
    let places = [[0.0, 0.0], [4.0, 0.4], [8.0, -0.4], [0.2, 4.0], [4.2, 4.4], [8.2, 3.8]];
    (places.iter().zip(0..))
        .map(|(at, k)| {
            let k = f64::from(k);
            map(grid(*at, (31, 31)), |p| {
                features(p) + noise_nm * gaussian(random) + 20.0 * k * k - 3.0 * k * p[0]
                    + (k - 2.0) * p[1]
            })
        })
        .collect()
}

/// Returns the joined map minus the true surface and minus the plane of the first map, nm, at valid pixels.
fn left(joined: &Surface) -> Vec<f64> {
    let g = joined.grid();
    let of = |((r, c), z): ((usize, usize), &f64)| {
        let p = [g.x.coordinate_mm(c), g.y.coordinate_mm(r)];
        // The first map (k = 0) has the plane -2 y.
        z - features(p) + 2.0 * p[1]
    };
    joined.height_nm().indexed_iter().map(of).filter(|v| !v.is_nan()).collect()
}

#[test]
fn sub_apertures_without_noise_join_exactly() {
    let random = &mut case_generator(55, 3, 0);
    let maps = mosaic(0.0, random);
    let found = join(&maps, &JoinSettings::default()).unwrap();
    // Rounding of heights of hundreds of nm.
    assert!(left(&found.joined).iter().all(|v| v.abs() < 1e-9));
    assert!(found.report.misfit_nm < 1e-10, "{:?}", found.report);
    // Every pixel of the union is valid, none beyond.
    let g = found.joined.grid();
    let inside = |p: [f64; 2]| {
        maps.iter().any(|m| {
            let m = m.grid();
            let within = |v: f64, a: &Axis| a.start_mm() - 1e-6 < v && v < a.end_mm() + 1e-6;
            within(p[0], &m.x) && within(p[1], &m.y)
        })
    };
    for ((r, c), z) in found.joined.height_nm().indexed_iter() {
        assert_eq!(!z.is_nan(), inside([g.x.coordinate_mm(c), g.y.coordinate_mm(r)]), "{r} {c}");
    }
    assert!(found.report.terms.iter().all(|t| !t.interpolated));
}

/// Checks that the misfit is the noise of one map. 5000 degrees of freedom give it to 1 %; the test allows three times
/// that.
#[test]
fn the_misfit_is_the_noise_of_a_map() {
    let random = &mut case_generator(55, 4, 0);
    let found = join(&mosaic(0.5, random), &JoinSettings::default()).unwrap();
    assert!((found.report.misfit_nm / 0.5 - 1.0).abs() < 0.03, "{}", found.report.misfit_nm);
    // A difference of two maps has sqrt(2) of it; the smallest overlap has some 300 pixels.
    for overlap in found.report.overlaps.iter().filter(|o| o.pixels > 300) {
        let ratio = overlap.rms_nm / (0.5 * 2.0_f64.sqrt());
        // 300 pixels know it to 1 / sqrt(600) = 4 %: five of it.
        assert!((ratio - 1.0).abs() < 0.2, "{overlap:?}");
    }
    let rest = left(&found.joined);
    // Noise, and planes of the maps whose coefficients have the noise of overlaps.
    let rms = (rest.iter().map(|v| v * v).sum::<f64>() / rest.len() as f64).sqrt();
    // Regression bound: 0.452 nm was seen, less than the noise of one map, because maps overlap.
    assert!(rms < 0.55, "{rms}");
}

#[test]
fn pixels_between_those_of_the_first_map_are_interpolated() {
    let one = map(grid([0.0; 2], (31, 31)), features);
    let two = map(grid([4.07, 0.13], (31, 31)), |p| features(p) + 7.0 - 0.3 * p[0]);
    let found = join(&[one, two], &JoinSettings::default()).unwrap();
    assert!(found.report.terms[1].interpolated);
    let g = found.joined.grid();
    for ((r, c), z) in found.joined.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
        // Keys' interpolation of waves of 2 mm and more at 0.2 mm: the error of the third order, 8 (k h)^3 / 24 and
        // less.
        assert!(
            (z - features([g.x.coordinate_mm(c), g.y.coordinate_mm(r)])).abs() < 0.05,
            "{r} {c}"
        );
    }
}

#[test]
fn islands_and_slivers_are_refused_by_the_map() {
    let at = |x: f64| map(grid([x, 0.0], (31, 31)), features);
    let settings = JoinSettings::default();
    let message = join(&[at(0.0), at(4.0), at(20.0)], &settings).unwrap_err();
    assert_eq!(message.index, 2);
    let text = message.to_string();
    assert!(
        text.contains("has at most 0 pixel(s) in common") && text.contains("30 are needed"),
        "{text}"
    );
    // One column in common determines no tilt along x.
    let thin = JoinSettings { least_overlap: 10, ..settings };
    let message = join(&[at(0.0), at(6.0)], &thin).unwrap_err();
    assert_eq!(message.index, 1);
    assert!(message.to_string().contains("to determine its tilt"), "{message}");
    let pistons = JoinSettings { differ_by: Difference::Piston, ..thin };
    // Two maps of the same heights: rounding.
    assert!(join(&[at(0.0), at(6.0)], &pistons).unwrap().report.misfit_nm < 1e-12);
    // A place in metres.
    let message = join(&[at(0.0), at(4e6)], &settings).unwrap_err().to_string();
    assert!(message.contains("needs a joined map of"), "{message}");
}
