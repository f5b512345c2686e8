//! `planish-surface line` from a file to its artifacts, and what it refuses.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::artifact;
use planish_testkit::program::{text, write};
use planish_types::{Axis, Grid, Surface, Tif};

fn run(dir: &Path, arguments: &str) -> Output {
    planish_testkit::program::stage("planish-surface")
        .current_dir(dir)
        .arg("line")
        .args(arguments.split_whitespace())
        .output()
        .unwrap()
}

/// Runs, expects exit code 2, one line and nothing written; returns the line.
fn refused(dir: &Path, arguments: &str) -> String {
    let output = run(dir, &format!("{arguments} --out refused"));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments}: {said}");
    assert!(said.starts_with("error: ") && !dir.join("refused").exists(), "{said}");
    said
}

fn tool(dir: &Path) {
    let a = Axis::new(-6.0, 0.5, 25).unwrap();
    let g = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        3.0 * (-(a.coordinate_mm(r).powi(2) + a.coordinate_mm(c).powi(2)) / 8.0).exp()
    });
    write(dir, "tif", &Tif::new(g, rate).unwrap());
}

#[test]
fn slopes_of_a_table_become_a_strip_and_its_tool() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    tool(dir);
    // A cylinder of 1 km: 1 urad/mm; the height is x^2 / 2 nm. Positions descend.
    let rows: Vec<String> =
        (0..81).rev().map(|i| format!("{},{}", f64::from(i) - 40.0, f64::from(i) - 40.0)).collect();
    fs::write(dir.join("ltp.csv"), format!("x (mm), slope (urad)\n{}\n", rows.join("\n"))).unwrap();
    let how = "--profile ltp.csv --value-unit urad --tif tif --strip-width-mm 4";
    let output = run(dir, &format!("{how} --positive hill --out line"));
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let surface = artifact::read::<Surface>(&dir.join("line/surface")).unwrap();
    let z = surface.value.height_nm();
    assert_eq!((z.dim(), surface.value.grid().y.start_mm()), ((3, 81), -2.0));
    for c in 0..81 {
        let x = c as f64 - 40.0;
        // Trapezoids are exact for a straight slope; rounding of 800 nm.
        assert!((z[[1, c]] - 0.5 * x * x).abs() < 1e-9, "{c} {}", z[[1, c]]);
    }
    let outcome = surface.manifest.unwrap().outcome;
    assert_eq!(outcome["integrated"], true);
    let tif = artifact::read::<Tif>(&dir.join("line/tif")).unwrap().value;
    // 3 sqrt(2 pi) 2 erf(2 / (2 sqrt 2)) / 4, to the third order of the interpolation.
    let want = 3.0 * (2.0 * std::f64::consts::PI).sqrt() * 2.0 * 0.682_689_492_137 / 4.0;
    assert!((tif.rate_at(0.0, 2.0) / want - 1.0).abs() < 1e-3, "{}", tif.rate_at(0.0, 2.0));

    let output = run(dir, &format!("{how} --positive hole --subtract piston --out hole"));
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let hole = artifact::read::<Surface>(&dir.join("hole/surface")).unwrap().value;
    // Rounding of 800 nm, as above.
    assert!((hole.height_nm()[[0, 40]] - 800.0).abs() < 1e-9);
    // The mean across a map is a profile, too.
    let again = "--surface line/surface --tif tif --pitch-mm 1 --out again";
    let output = run(dir, again);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
}

#[test]
fn what_is_not_stated_or_makes_no_line_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    tool(dir);
    let table = |name: &str, of: &dyn Fn(usize) -> String| {
        let rows: Vec<String> = (0..30).map(of).collect();
        fs::write(dir.join(name), rows.join("\n")).unwrap();
    };
    table("good.csv", &|i| format!("{i} {}", i * i));
    table("twice.csv", &|i| format!("{} {i}", i / 2));
    table("far.csv", &|i| format!("{i} {}", if i == 7 { 1e30 } else { 0.0 }));
    let rest = "--tif tif --strip-width-mm 4";
    let good = format!("--profile good.csv --value-unit nm --positive hill {rest}");
    assert_eq!(run(dir, &format!("{good} --out fine")).status.code(), Some(0));
    for (arguments, parts) in [
        (format!("--profile good.csv --positive hill {rest}"), ["--value-unit", "required"]),
        (format!("--profile good.csv --value-unit nm {rest}"), ["--positive", "required"]),
        (
            "--profile good.csv --value-unit nm --positive hill --tif tif".into(),
            ["--strip-width-mm", "required"],
        ),
        (good.replace("mm 4", "mm -4"), ["strip_width_mm: is -4", "positive"]),
        (format!("{good} --pixel-mm 0"), ["pixel_mm: is 0 mm", "2 to"]),
        (format!("{good} --subtract cylinder-y"), ["cylinder", "profile"]),
        (good.replace("good", "twice"), ["position[1]: 0 mm follows 0 mm", "sort"]),
        (good.replace("good", "far"), ["height[7]: is 1", "--value-unit"]),
        (good.replace("good", "absent"), ["absent.csv", ""]),
    ] {
        let said = refused(dir, &arguments);
        assert!(parts.iter().all(|part| said.contains(part)), "{arguments}: {said}");
    }
}
