//! The binary from end to end, and the files of real instruments where `PLANISH_REFERENCE` names the
//! folder that holds them.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use planish_handoff::artifact::{self, Manifest};
use planish_testkit::skipped::reference;
use planish_types::{Surface, Trajectory};

fn call(dir: &Path, arguments: &[&str]) -> Output {
    planish_testkit::program::stage("planish-import")
        .current_dir(dir)
        .args(arguments)
        .output()
        .unwrap()
}

/// Runs the program, and checks that the exit code is 0. Returns its standard output and its warnings.
fn done(dir: &Path, arguments: &[&str]) -> (String, String) {
    let output = call(dir, arguments);
    let text = |b: &[u8]| String::from_utf8_lossy(b).into_owned();
    let (said, warned) =
        (text(&output.stdout), String::from_utf8_lossy(&output.stderr).into_owned());
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {said}{warned}");
    (said, warned)
}

/// Runs the program, and checks that the exit code is 2, the message has one line, and nothing is written. Returns that
/// line.
fn refused(dir: &Path, arguments: &[&str]) -> String {
    let output = call(dir, &[arguments, &["--out", "refused"]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
    assert!(output.stdout.is_empty() && said.starts_with("error: "), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(!dir.join("refused").exists(), "{arguments:?}");
    said
}

fn surface(dir: &Path) -> (Surface, Manifest) {
    let loaded = artifact::read::<Surface>(dir).unwrap();
    (loaded.value, loaded.manifest.unwrap())
}

const CSV: &str = "1,2,3\n4,nan,6\n";

#[test]
fn a_map_its_statement_and_its_picture() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    fs::write(dir.join("a.csv"), CSV).unwrap();
    let flags = ["surface", "a.csv", "--unit", "um", "--pixel-mm", "0.5,0.25", "--negate"];
    let more = ["--first-row", "top", "--picture", "p/a.svg", "--origin", "centre", "--out", "a"];
    let (said, _) = done(dir, &[&flags[..], &more].concat());
    assert!(said.contains("stored value 1 is -1000 nm of surface (unit: asked for)"), "{said}");
    assert!(said.contains("the first row of the file is the top"), "{said}");
    let (map, manifest) = surface(&dir.join("a"));
    assert_eq!(map.height_nm().row(1).to_vec(), [-1000.0, -2000.0, -3000.0]);
    assert!(map.height_nm()[[0, 1]].is_nan());
    assert_eq!((map.grid().x.start_mm(), map.grid().y.start_mm()), (-0.5, -0.125));
    let reading = &manifest.outcome["reading"];
    assert_eq!((&reading["format"], &reading["invalid"]), (&"csv".into(), &1.into()));
    assert_eq!(manifest.inputs[0].kind, "file");
    let picture = fs::read_to_string(dir.join("p/a.svg")).unwrap();
    assert!(picture.contains("a.csv: 3 x 2 pixels, 1 invalid"), "{picture}");
    // Again: nothing to do. Without --force another file is not replaced.
    let (said, _) = done(dir, &[&flags[..], &more].concat());
    assert!(said.contains("unchanged"), "{said}");
    let other = ["surface", "a.csv", "--unit", "nm", "--pixel-mm", "1", "--out", "a"];
    assert_eq!(call(dir, &other).status.code(), Some(2));
}

#[test]
fn a_flat_strip_with_a_hostile_name_has_a_picture() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let name = "a<b>\u{1b}[31m\u{8}.csv";
    let row = ["0"; 300].join(",");
    fs::write(dir.join(name), format!("{row}\n{row}\n")).unwrap();
    let flags = ["--unit", "nm", "--pixel-mm", "0.5", "--first-row", "top", "--picture", "a.svg"];
    done(dir, &[&["surface", name][..], &flags, &["--out", "a"]].concat());
    let picture = fs::read_to_string(dir.join("a.svg")).unwrap();
    assert!(picture.contains(r"a&lt;b&gt;\u{1b}[31m\u{8}.csv: 300 x 2 pixels"), "{picture}");
    assert!(!picture.contains(|c: char| c != '\n' && c.is_control()));
    assert!(!picture.contains("NaN") && !picture.contains("inf"), "{picture}");
    // The bar of colours (100 px below a margin of 60) is inside the picture.
    let height = picture.split("height=\"").nth(1).unwrap().split('"').next().unwrap();
    assert!(height.parse::<f64>().unwrap() >= 160.0, "{height}");
}

#[test]
fn a_directory_of_npy_is_a_format_too() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    fs::write(dir.join("a.csv"), CSV).unwrap();
    done(dir, &["surface", "a.csv", "--unit", "nm", "--pixel-mm", "0.1", "--out", "a"]);
    fs::remove_file(dir.join("a/manifest.json")).unwrap();
    done(dir, &["surface", "a", "--flip-x", "--out", "b"]);
    assert_eq!(surface(&dir.join("b")).0.height_nm().row(0).to_vec(), [3.0, 2.0, 1.0]);
}

#[test]
fn a_program_becomes_a_motion() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    fs::write(dir.join("p.trj"), "0.1, 1, 0, 0, 0\n0.2, 0, 0, 0, 0\n").unwrap();
    let base = ["program", "p.trj", "--controller", "xps"];
    assert!(refused(dir, &base).contains("give --start-mm"));
    done(dir, &[&base[..], &["--start-mm", "-1,2", "--out", "a"]].concat());
    let motion = artifact::read::<Trajectory>(&dir.join("a")).unwrap().value;
    assert_eq!(motion.segment(1).position_mm(0.1), [0.0, 2.0]);
    fs::write(dir.join("p.trj.json"), "{\"start_mm\": [-1.0, 2.0], \"machine\": \"m\"}").unwrap();
    done(dir, &[&base[..], &["--about", "p.trj.json", "--out", "b"]].concat());
    assert_eq!(artifact::read::<Trajectory>(&dir.join("b")).unwrap().value, motion);
}

/// Checks a file beside the program that belongs to another program. Both are written one after the other, so that a
/// kill between them can leave such a pair.
#[test]
fn the_file_beside_another_program_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let program = "0.1, 1, 0, 0, 0\n0.2, 0, 0, 0, 0\n";
    fs::write(dir.join("p.trj"), program).unwrap();
    let about = |of: &str| {
        let hash = blake3::hash(of.as_bytes()).to_hex().to_string();
        let about = serde_json::json!({ "start_mm": [0.0, 0.0], "program_blake3": hash });
        fs::write(dir.join("p.trj.json"), about.to_string()).unwrap();
    };
    let base = ["program", "p.trj", "--controller", "xps", "--about", "p.trj.json"];
    about("0.1, 10, 0, 0, 0\n");
    let said = refused(dir, &base);
    assert!(said.contains("p.trj: program_blake3: is") && said.contains("export again"), "{said}");
    about(program);
    done(dir, &[&base[..], &["--out", "a"]].concat());
}

#[test]
fn a_program_that_loses_words_is_refused_with_its_line() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    for (line, expected) in [
        ("G1 X5 ) Y7 F60", "program line[3]: has ) without a comment"),
        ("G1 X5 F60 (Y7", "program line[3]: has a comment that does not end"),
        ("G1 X5 X6 F60", "program line[3]: has the word X twice"),
        ("M63 P0", "ends with an M62 or M63 that no motion follows"),
    ] {
        let text = format!("G0 X0 Y0\nG94\n{line}\nM2\n");
        fs::write(dir.join("p.ngc"), text).unwrap();
        let said = refused(dir, &["program", "p.ngc", "--controller", "gcode"]);
        assert!(said.contains(expected), "{line}: {said}");
    }
}

#[test]
fn bad_files_and_flags_are_one_message() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let put = |name: &str, bytes: &[u8]| fs::write(dir.join(name), bytes).unwrap();
    put("a.csv", CSV.as_bytes());
    put("b.csv", b"1,2\n3,four\n");
    put("c.bin", b"what is this");
    put("d.dat", b"\x88\x1b\x03\x6f\x00\x01\x00\x00\x03\x42short");
    put("e.dat", &[0; 100]);
    let nm = ["--unit", "nm", "--pixel-mm", "1"];
    for (arguments, expected) in [
        (vec!["surface", "none.csv"], "none.csv: cannot read"),
        (vec!["surface", "a.csv"], "a.csv: unit: is not in the file"),
        (vec!["surface", "a.csv", "--unit", "nm"], "a.csv: pixel_mm: is not in the file"),
        (vec!["surface", "a.csv", "--unit", "nm", "--pixel-mm", "0"], "pixel_mm: is 0"),
        (vec!["surface", "a.csv", "--unit", "waves", "--pixel-mm", "1"], "--wavelength-nm"),
        (vec!["surface", "b.csv"], "\"four\" in line 2, field 2"),
        (vec!["surface", "c.bin"], "give --format"),
        (vec!["surface", "c.bin", "--format", "hdf5"], "signature of HDF5"),
        (vec!["surface", "d.dat"], "is truncated"),
        (vec!["surface", "e.dat", "--format", "metropro"], "magic 00000000"),
        (vec!["surface", "a.csv", "--dataset", "Z"], "leave it out"),
        (vec!["surface", "a.csv", "--surface-per-value", "0"], "surface_per_value: is 0"),
        (vec!["tif", "a.csv", "--rate"], "is NaN"),
    ] {
        let flags = if expected == "surface_per_value: is 0" || expected == "is NaN" {
            &nm[..]
        } else {
            &[]
        };
        let said = refused(dir, &[&arguments[..], flags].concat());
        assert!(said.contains(expected), "{arguments:?}: {said}");
    }
}

/// Checks a file of some kilobytes that claims gigabytes. The program runs in an address space of 1.5 GiB.
#[test]
fn what_a_header_claims_takes_no_memory() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let mut dat = vec![0; 834];
    dat[..10].copy_from_slice(b"\x88\x1b\x03\x6f\x00\x01\x00\x00\x03\x42");
    // 0x8000 x 0x8000 pixels of 4 bytes: 4 GiB.
    dat[68..72].copy_from_slice(&[0x80, 0, 0x80, 0]);
    fs::write(dir.join("a.dat"), &dat).unwrap();
    let mut npy = b"\x93NUMPY\x01\x00\x4e\x00".to_vec();
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (23170, 23170), }";
    npy.extend(format!("{header:<77}\n").bytes());
    fs::write(dir.join("a.npy"), npy).unwrap();
    let card = |text: &str| format!("{text:<80}");
    let cards = [
        "SIMPLE  = T",
        "BITPIX  = -64",
        "NAXIS   = 2",
        "NAXIS1  = 23170",
        "NAXIS2  = 23170",
        "END",
    ];
    let fits: String = cards.iter().map(|c| card(c)).collect();
    fs::write(dir.join("a.fits"), format!("{fits:<2880}")).unwrap();
    for name in ["a.dat", "a.npy", "a.fits"] {
        let program = format!("{} planish-import", planish_testkit::program::planish().display());
        let line = format!(
            "ulimit -v 1700000; exec {program} surface {name} --unit nm --pixel-mm 1 --out out"
        );
        let output = Command::new("sh").args(["-c", &line]).current_dir(dir).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{name}: {said}");
        assert!(said.contains("at most 33554432 pixels") && said.lines().count() == 1, "{said}");
    }
}

#[test]
fn real_files_have_their_published_values() {
    let Some(files) = reference().map(|dir| dir.join("instruments")) else { return };
    let tmp = tempfile::tempdir().unwrap();
    let read = |name: &str, flags: &[&str]| {
        let file = files.join(name);
        let base = ["surface", file.to_str().unwrap(), "--force", "--out", "out"];
        done(tmp.path(), &[&base[..], flags].concat());
        surface(&tmp.path().join("out"))
    };
    let range = |s: &Surface| {
        let valid = s.height_nm().iter().filter(|v| !v.is_nan());
        valid.fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(*v), b.max(*v)))
    };
    let close = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-12; // rounding of two orders of factors

    let (map, manifest) = read("metropro-1.dat", &[]);
    let (low, high) = range(&map);
    assert!(close(low, 50_108.275_682_971_34) && close(high, 51_471.332_012_260_55));
    assert_eq!(map.height_nm().dim(), (480, 640));
    assert_eq!(manifest.outcome["reading"]["invalid"], 0);
    assert!(close(map.grid().x.step_mm(), 1.098_252_027_986_745_8e-3));

    let (map, manifest) = read("zygo_test.datx", &[]);
    let pv_nm = manifest.outcome["pv_nm"].as_f64().unwrap();
    let nm_per_fringe = manifest.outcome["reading"]["nm_per_value"].as_f64().unwrap();
    assert!(close(pv_nm / nm_per_fringe, 0.462_942_656_580_933_9 + 0.968_885_700_752_118_3));
    // The published PV takes 632.8 nm; the wavelength in the file passed through a 32-bit float.
    assert!((pv_nm / 453.030_492_260_177_7 - 1.0).abs() < 1e-7);
    let valid = map.height_nm().iter().filter(|v| !v.is_nan()).count();
    assert_eq!((map.height_nm().dim(), valid), ((259, 33), 7771));
    // The pitch passed through a 32-bit float.
    assert!((map.grid().x.step_mm() - 1.0).abs() < 1e-7);

    let si = ["--unit", "m", "--coordinate-unit", "m"];
    let (map, _) = read("initial_map.mat", &si);
    assert_eq!(map.height_nm().dim(), (271, 271));
    let (map, _) = read("pvt_model_scheduler.h5", &si);
    assert_eq!(map.height_nm().dim(), (55, 55));
    let (map, _) = read("sdf-1.sdf", &[]);
    assert_eq!((map.height_nm().dim(), range(&map).1), ((4, 7), 1000.0));
    let (map, _) =
        read("xyz-1.txt", &["--format", "xyz", "--unit", "um", "--coordinate-unit", "mm"]);
    assert_eq!((map.height_nm().dim(), range(&map)), ((4, 4), (1000.0, 2000.0)));
}

/// Returns an XPS gathering of 0.5 s at 1 kHz: a motion along x at 20 mm/s, whose axes lag by 2 ms.
fn gathering() -> String {
    let at = |t: f64| 20.0 * t.max(0.0) + (9.0 * t).sin();
    let line = |i: i32| {
        let t = f64::from(i) * 1e-3;
        let [set, is] = [at(t), at(t - 2e-3)];
        format!("{set:.7};{is:.7};{:.7};{:.7};\n", -set / 2.0, -is / 2.0)
    };
    (0..=500).map(line).collect()
}

#[test]
fn a_gathering_becomes_the_motion_that_was_made() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    fs::write(dir.join("Gathering.dat"), gathering()).unwrap();
    let flags = ["trace", "Gathering.dat", "--format", "xps", "--unit", "mm", "--rate-hz", "1000"];
    let (said, warned) = done(dir, &[&flags[..], &["--out", "run"]].concat());
    assert!(said.contains("501 samples over 0.5000 s at 1000 Hz (asked for)"), "{said}");
    assert!(said.contains("x beside the setpoint") && warned.is_empty(), "{said}{warned}");
    let loaded = artifact::read::<Trajectory>(&dir.join("run")).unwrap();
    assert_eq!((loaded.value.len(), loaded.value.rate_factor()), (500, None));
    let manifest = loaded.manifest.unwrap();
    // A plan and a log without a current are of the same version.
    assert_eq!((manifest.version, manifest.arrays.len()), (1, 4));
    let axes = &manifest.outcome["following_setpoint"]["axes"];
    for axis in 0..2 {
        let lag = axes[axis]["lag_ms"].as_f64().unwrap();
        // The first two of 501 samples, where the setpoint is clamped at its beginning.
        assert!((lag - 2.0).abs() < 0.02, "{axes}");
    }
    // Again: nothing to do.
    assert!(done(dir, &[&flags[..], &["--out", "run"]].concat()).0.contains("unchanged"));

    // Beside the plan, whose clock begins 0.1 s later than the log.
    let late = ["--from-s", "0.1", "--planned", "run", "--tool-from-plan", "--out", "late"];
    let (said, _) = done(dir, &[&flags[..], &late].concat());
    assert!(said.contains("the plan begins -0.1"), "{said}");
    let refusals: [(&[&str], &str); 5] = [
        (&["trace", "Gathering.dat"], "give --format"),
        (&["trace", "Gathering.dat", "--format", "xps", "--rate-hz", "1000"], "give --unit"),
        (&["trace", "Gathering.dat", "--format", "xps", "--unit", "mm"], "give --rate-hz"),
        (&["trace", "Gathering.dat", "--format", "csv", "--unit", "mm", "--x", "9"], "x: is \"9\""),
        (&["trace", "Gathering.dat", "--format", "hdf5", "--unit", "mm"], "signature of HDF5"),
    ];
    for (arguments, expected) in refusals {
        let said = refused(dir, arguments);
        assert!(said.contains("Gathering.dat: ") && said.contains(expected), "{said}");
    }
}

#[test]
fn a_beam_current_is_a_rate_factor_of_version_2() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let line =
        |i: i32| format!("{},{},0,{}\n", f64::from(i) * 0.01, i, if i < 50 { 2.0 } else { 1.0 });
    let log: String =
        ["t_s,x_um,y_um,current\n".to_string()].into_iter().chain((0..100).map(line)).collect();
    fs::write(dir.join("log.csv"), log).unwrap();
    let (said, _) = done(dir, &["trace", "log.csv", "--nominal-current", "2", "--out", "run"]);
    assert!(said.contains("current \"current\""), "{said}");
    let loaded = artifact::read::<Trajectory>(&dir.join("run")).unwrap();
    let factor = loaded.value.rate_factor().unwrap();
    assert_eq!((factor[0], factor[49], factor[98]), (1.0, 0.75, 0.5));
    let manifest = loaded.manifest.unwrap();
    assert_eq!((manifest.version, manifest.arrays.len()), (2, 5));
    // 49 pieces with 1, one with 0.75 and 49 with 0.5: rounding.
    assert!((manifest.outcome["rate_factor"]["mean"].as_f64().unwrap() - 0.75).abs() < 1e-12);
    // Without the file that the manifest lists the artifact is damaged, not one of version 1.
    fs::remove_file(dir.join("run/rate_factor.npy")).unwrap();
    let said = artifact::read::<Trajectory>(&dir.join("run")).unwrap_err().to_string();
    assert!(said.contains("rate_factor.npy: is missing"), "{said}");
    let said = refused(dir, &["trace", "log.csv"]);
    assert!(said.contains("give --nominal-current"), "{said}");
}

#[test]
fn a_current_in_another_unit_than_the_nominal_one_is_refused_with_both() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let log = |current: f64| {
        let line = |i: i32| format!("{},{i},0,{current}\n", f64::from(i) * 0.01);
        let lines: String = (0..100).map(line).collect();
        fs::write(dir.join("log.csv"), format!("t_s,x_um,y_um,current\n{lines}")).unwrap();
    };
    let flags = ["trace", "log.csv", "--nominal-current", "5"];
    for (current, expected) in [
        (
            5000.0,
            "current[0]: is 5000, and --nominal-current is 5: the tool would remove 1000 times as fast",
        ),
        (
            0.005,
            "current[0]: is 0.005, and --nominal-current is 5: the tool would remove 0.001 times as fast",
        ),
    ] {
        log(current);
        let said = refused(dir, &flags);
        assert!(said.contains(expected) && said.contains("in the unit of the log"), "{said}");
    }
    // Twice the current of the TIF is another beam; half of it more is not.
    log(11.0);
    let (_, warned) = done(dir, &[&flags[..], &["--out", "a"]].concat());
    let expected = "the mean current with the beam on is 11, and --nominal-current is 5: the tool removes 2.2 times";
    assert!(warned.contains(expected), "{warned}");
    log(7.5);
    let (_, warned) = done(dir, &[&flags[..], &["--out", "b"]].concat());
    assert!(warned.is_empty(), "{warned}");
}

/// Writes a plan of 10 s with the tool off in two segments of 1 s, and its log up to `until_s`. `on(t)` is the tool
/// state in the log.
fn plan_and_log(dir: &Path, until_s: f64, on: Option<&dyn Fn(f64) -> bool>) {
    let is_on = |i: usize| i != 3 && i != 7;
    let c = |i: usize| {
        let x = [10.0 * (i as f64 * 0.9).sin(), 10.0 * ((i + 1) as f64 * 0.9).sin()];
        [[x[0], x[1] - x[0], 0.0, 0.0], [i as f64, 1.0, 0.0, 0.0]]
    };
    let plan = Trajectory::new(
        (0..=10).map(f64::from).collect(),
        (0..10).map(c).collect(),
        (0..10).map(is_on).collect(),
        vec![None; 10],
    )
    .unwrap();
    planish_handoff::save(&dir.join("plan"), &plan).unwrap();
    let mut log =
        "t (s),x (mm),y (mm)".to_string() + if on.is_some() { ",tool_on\n" } else { "\n" };
    for k in 0..=(100.0 * until_s) as usize {
        let t = k as f64 * 0.01;
        let segment = plan.segment((t as usize).min(9));
        let [x, y] = segment.position_mm(t - segment.start_s);
        log += &format!("{t:.4},{x:.6},{y:.6}");
        log += &on.map_or(String::new(), |on| format!(",{}", u8::from(on(t))));
        log += "\n";
    }
    fs::write(dir.join("log.csv"), log).unwrap();
}

fn planned_on(t: f64) -> bool {
    !(3.0..4.0).contains(&t) && !(7.0..8.0).contains(&t)
}

#[test]
fn a_log_of_half_of_the_run_is_a_negative_verdict_with_the_numbers() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    plan_and_log(dir, 5.0, Some(&planned_on));
    let output = call(dir, &["trace", "log.csv", "--planned", "plan", "--out", "run"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    let expected = "verdict: the log is not one of the whole run: the log holds 5 s, and the plan takes 10 s: it lacks \
                    the first 0 s and the last 5 s of the plan, in which the plan has the tool on for 4 s of 8 s";
    assert!(said.contains(expected), "{said}");
    let beside = artifact::read::<Trajectory>(&dir.join("run")).unwrap().manifest.unwrap().outcome;
    // The beginning of the log beside the plan is found. Regression bound: 2.4e-9 s was seen.
    assert!((beside["beside_plan"]["after_the_log_s"].as_f64().unwrap() - 5.0).abs() < 1e-4);
    // Cut on request it is what was asked for, and said.
    let flags = ["trace", "log.csv", "--planned", "plan", "--until-s", "4", "--out", "cut"];
    let (_, warned) = done(dir, &flags);
    assert!(warned.contains("warning: the log holds 4 s, and the plan takes 10 s"), "{warned}");
    // The whole log says nothing.
    plan_and_log(dir, 10.0, Some(&planned_on));
    let (_, warned) = done(dir, &["trace", "log.csv", "--planned", "plan", "--out", "whole"]);
    assert!(warned.is_empty(), "{warned}");
}

#[test]
fn a_tool_that_is_not_that_of_the_plan_is_named() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let flags = ["trace", "log.csv", "--planned", "plan", "--out"];
    let ended = |out: &str| {
        let output = call(dir, &[&flags[..], &[out]].concat());
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    plan_and_log(dir, 10.0, Some(&|t| !planned_on(t)));
    let (code, said) = ended("inverted");
    assert_eq!(code, Some(1), "{said}");
    assert!(
        said.contains("verdict: the tool of the log is not that of the plan: in 10 s of 10 s"),
        "{said}"
    );
    assert!(said.contains("is it inverted?"), "{said}");
    // Half of a lift with the tool on.
    plan_and_log(dir, 10.0, Some(&|t| planned_on(t) || t < 3.5));
    let (code, said) = ended("lift");
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("warning: in 0.5 s of 10 s one of the log and the plan has the tool on"),
        "{said}"
    );
    // A log without a switch, whose motion would remove while the plan is lifted.
    plan_and_log(dir, 10.0, None);
    let (code, said) = ended("untold");
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("the plan has it off for 2 s of it: the motion removes there, too"),
        "{said}"
    );
    let (_, warned) = done(dir, &[&flags[..], &["from-plan", "--tool-from-plan"]].concat());
    assert!(warned.is_empty(), "{warned}");
}
