//! The program from its flags to its files and exit codes.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::artifact;
use planish_testkit::program::{text, write};
use planish_types::{Axis, DwellTime, Grid, Surface, ToolPath, Trajectory, Transform};

fn run(dir: &Path, arguments: &str) -> Output {
    planish_testkit::program::stage("planish-register")
        .current_dir(dir)
        .args(arguments.split_whitespace())
        .output()
        .unwrap()
}

fn done(dir: &Path, arguments: &str) -> String {
    let output = run(dir, arguments);
    assert_eq!(output.status.code(), Some(0), "{arguments}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Runs the program, and checks that the exit code is 2, the message has one line, and nothing is written. Returns that
/// line.
fn refused(dir: &Path, arguments: &str) -> String {
    let output = run(dir, &format!("{arguments} --out refused"));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments}: {said}");
    assert!(output.stdout.is_empty() && said.starts_with("error: "), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(!dir.join("refused").exists(), "{arguments}");
    said
}

/// Fiducials at the corners of 100 x 60 mm. The machine sees them turned by 90 degrees and shifted by (300, 40) mm.
const FIDUCIALS: &str = "name,map_x_mm,map_y_mm,machine_x_mm,machine_y_mm,uncertainty_mm\n\
                         a,0,0,300.001,40,0.005\nb,100,0,300,139.999,0.005\n\
                         c,100,60,240,140,0.005\nd,0,60,239.999,40.001,0.005\n";

fn motion() -> Trajectory {
    let c = [[10.0, 2.0, -0.5, 0.1], [20.0, 0.2, 0.4, -0.3]];
    Trajectory::new(vec![0.0, 2.0], vec![c], vec![true], vec![Some(0)]).unwrap()
}

#[test]
fn a_motion_goes_to_the_machine_and_back() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    fs::write(dir.join("f.csv"), FIDUCIALS).unwrap();
    let said = done(dir, "fit f.csv --out t");
    assert!(said.contains("4 fiducials, turned by 89.9") && said.contains("miss by"), "{said}");
    let loaded = artifact::read::<Transform>(&dir.join("t")).unwrap();
    let q = loaded.value.point([10.0, 20.0]);
    // The fiducials are off by up to 1 um, and the fit by no more: twice that.
    assert!((q[0] - 280.0).abs() < 2e-3 && (q[1] - 50.0).abs() < 2e-3, "{q:?}");
    let manifest = loaded.manifest.unwrap();
    assert_eq!(manifest.outcome["registration"]["degrees_of_freedom"], 5);

    write(dir, "motion", &motion());
    done(dir, "apply --transform t --trajectory motion --out there");
    let there = artifact::read::<Trajectory>(&dir.join("there")).unwrap();
    let manifest = there.manifest.unwrap();
    assert!(manifest.frame.starts_with("machine coordinates"), "{}", manifest.frame);
    assert_eq!(manifest.settings["transform"]["matrix"][0][0], loaded.value.matrix()[0][0]);
    let p = there.value.segment(0).position_mm(0.0);
    // Rounding of coordinates of 300 mm.
    assert!((0..2).all(|a| (p[a] - q[a]).abs() < 1e-12), "{p:?}");
    // Twice would be somewhere else.
    let twice = refused(dir, "apply --transform t --trajectory there");
    assert!(twice.contains("there: is in the coordinates of the machine already"), "{twice}");
    let back = "apply --transform t --trajectory there --inverse --out back";
    done(dir, back);
    let back = artifact::read::<Trajectory>(&dir.join("back")).unwrap();
    assert!(back.manifest.unwrap().frame.starts_with("part coordinates"));
    for (a, b) in back.value.coefficient_mm()[0].iter().zip(&motion().coefficient_mm()[0]) {
        // Rounding of coordinates of 300 mm, there and back.
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-11), "{a:?} {b:?}");
    }
    let path = ToolPath::new(vec![[0.0; 2], [2.0, 0.0]], vec![[1.0, 0.0]], vec![true], vec![0]);
    write(dir, "path", &path.unwrap());
    done(dir, "apply --transform t --tool-path path --out path-there");
    let path = artifact::read::<ToolPath>(&dir.join("path-there")).unwrap().value;
    assert_eq!(path.dwell_point_mm()[0], loaded.value.point([1.0, 0.0]));
    // Again: nothing to do.
    assert!(done(dir, "fit f.csv --out t").contains("unchanged"));
}

#[test]
fn the_distance_of_a_plan_from_its_path_goes_with_it() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    fs::write(dir.join("f.csv"), FIDUCIALS).unwrap();
    done(dir, "fit f.csv --model similarity --out t");
    let points = [[0.0, 0.0], [4.0, 0.0], [8.0, 1.0], [9.0, 5.0], [3.0, 6.0]].to_vec();
    let path = ToolPath::through(points, vec![true; 4], vec![0; 4]).unwrap();
    write(dir, "line", &path);
    write(dir, "times", &DwellTime::new(vec![1.0, 0.2, 2.0, 0.5]).unwrap());
    let machine =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/machines/ion-beam.json");
    let planned = planish_testkit::program::stage("planish-schedule")
        .current_dir(dir)
        .args("pvt --tool-path line --dwell times --out planned --machine".split(' '))
        .arg(machine)
        .output()
        .unwrap();
    assert_eq!(planned.status.code(), Some(0), "{}", text(&planned.stderr));
    done(dir, "apply --transform t --trajectory planned --out moved");
    let distances = ["planned", "moved"].map(|name| {
        let made = artifact::read::<Trajectory>(&dir.join(name)).unwrap().manifest.unwrap();
        let distance = &made.outcome["path_distance"];
        assert_eq!(distance["within"], true, "{name}: {distance}");
        [&distance["tool_on_mm"], &distance["tolerance_mm"]].map(|mm| mm.as_f64().unwrap())
    });
    let stretch = artifact::read::<Transform>(&dir.join("t")).unwrap().value.scale();
    for (planned, moved) in distances[0].iter().zip(&distances[1]) {
        // Both are the same number but for the rounding of the scale.
        assert!(*planned > 0.0 && (moved / planned / stretch - 1.0).abs() < 1e-9, "{distances:?}");
    }
}

#[test]
fn what_is_mirrored_or_does_not_fit_is_said() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let mirrored = FIDUCIALS.replace("240,140", "360,140").replace("239.999", "360.001");
    fs::write(dir.join("m.csv"), mirrored).unwrap();
    for model in ["rigid", "similarity", "affine"] {
        let said = refused(dir, &format!("fit m.csv --model {model}"));
        assert!(said.contains("m.csv: matrix: mirrors"), "{said}");
    }
    fs::write(dir.join("w.csv"), FIDUCIALS.replace("139.999", "140.3")).unwrap();
    let output = run(dir, "fit w.csv --out w");
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("verdict: the fiducials miss by"));
    assert!(dir.join("w").exists());
    fs::write(dir.join("bad.csv"), "x,y\n1,2\n").unwrap();
    assert!(refused(dir, "fit bad.csv").contains("bad.csv: fiducial: has the column"));
    fs::write(dir.join("empty.csv"), "").unwrap();
    assert!(refused(dir, "fit empty.csv").contains("give a header"));
    fs::write(dir.join("bytes.csv"), b"\xff\xfe\x00").unwrap();
    assert!(refused(dir, "fit bytes.csv").contains("bytes.csv"));
    assert!(refused(dir, "fit absent.csv").contains("absent.csv"));
    write(dir, "motion", &motion());
    assert!(
        refused(dir, "apply --transform motion --trajectory motion").contains("needs a transform")
    );
}

fn surface(start: [f64; 2], of: impl Fn([f64; 2]) -> f64) -> Surface {
    let axis = |start: f64, n: usize| Axis::new(start, 0.2, n).unwrap();
    let g = Grid { x: axis(start[0], 40), y: axis(start[1], 30) };
    let z =
        Array2::from_shape_fn(g.shape(), |(r, c)| of([g.x.coordinate_mm(c), g.y.coordinate_mm(r)]));
    Surface::new(g, z).unwrap()
}

#[test]
fn measurements_in_series_become_one_map() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let wave = |p: [f64; 2]| (1.3 * p[0]).sin() + p[1];
    write(dir, "a", &surface([0.0; 2], wave));
    write(dir, "b", &surface([0.0; 2], |p| wave(p) + 3.0 * p[0]));
    write(dir, "c", &surface([4.0, 1.0], |p| wave(p) - 5.0));
    write(dir, "far", &surface([40.0, 1.0], wave));

    let said = done(dir, "mean a b --still --out mean");
    assert!(said.contains("mean of 2 maps, 1200 pixels"), "{said}");
    let loaded = artifact::read::<Surface>(&dir.join("mean")).unwrap();
    // Rounding of heights of 30 nm.
    assert!(loaded.value.deviation_nm().unwrap().iter().all(|s| *s < 1e-12));
    let manifest = loaded.manifest.unwrap();
    assert_eq!(manifest.version, 2);
    assert_eq!(manifest.outcome["series"]["maps"], 2);
    // A map without deviations is what it was.
    let plain = artifact::read::<Surface>(&dir.join("a")).unwrap();
    assert!(plain.value.deviation_nm().is_none() && plain.manifest.unwrap().version == 1);

    let said = done(dir, "join a c --out whole");
    assert!(
        said.contains("2 maps joined to 60 x 35 pixels, 1900 valid, 500 in overlaps"),
        "{said}"
    );

    let said = refused(dir, "mean a far --still");
    assert!(said.contains("far: map: has 0 valid pixel(s) in common with the first map"), "{said}");
    let said = refused(dir, "mean a b");
    assert!(said.contains("b: ") && said.contains("or --still if the part lay still"), "{said}");
    let said = refused(dir, "mean a");
    assert!(said.contains("a: series: has 1 map(s); give 2 to"), "{said}");
    let said = refused(dir, "mean a b --still --free-order 9");
    assert!(said.contains("error: free_order: is 9; give 0 to 8"), "{said}");
    let said = refused(dir, "join a far c");
    assert!(said.contains("far: mosaic: has at most 0 pixel(s) in common"), "{said}");
    assert!(said.contains("--least-overlap"), "{said}");
}

#[test]
fn maps_at_one_place_are_averaged_and_not_joined() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let piece = |place_mm: f64, start: usize| {
        let grid =
            Grid { x: Axis::new(place_mm, 0.5, 24).unwrap(), y: Axis::new(0.0, 0.5, 16).unwrap() };
        let z = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let x = (start + c) as f64;
            8.0 * (0.3 * x).sin() + 5.0 * (0.4 * r as f64 + 0.1 * x).cos()
        });
        Surface::new(grid, z).unwrap()
    };
    for (k, start) in [0, 18].into_iter().enumerate() {
        write(dir, &format!("placed{k}"), &piece(0.5 * start as f64, start));
        write(dir, &format!("plain{k}"), &piece(0.0, start));
    }
    let output = run(dir, "join plain0 plain1 --out plain");
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(
        said.contains("all maps lie at the same place") && said.contains("--place-mm"),
        "{said}"
    );
    let output = run(dir, "join placed0 placed1 --out placed");
    assert!(output.status.success() && text(&output.stderr).is_empty(), "{}", text(&output.stderr));
    let joined = artifact::read::<Surface>(&dir.join("placed")).unwrap();
    assert_eq!(joined.value.height_nm().dim(), (16, 42));
    // The pieces are equal where they overlap, in 6 x 16 pixels: rounding of 13 nm.
    assert!(joined.manifest.unwrap().outcome["join"]["misfit_nm"].as_f64().unwrap() < 1e-9);
}
