//! Flags that nobody means, degenerate maps and tools, mistaken units, through the binary.

use planish_testkit::hostile::{COUNTS, FLOATS, every_value, inputs, survives};

const BINARY: &str = "planish-toolpath";
const OUT: &str = "--out=out";

/// A method, its numeric flags and its counts, and what it needs beside the flag under test.
type Case =
    (&'static str, &'static [&'static str], &'static [&'static str], &'static [&'static str]);

const CASES: [Case; 5] = [
    (
        "raster",
        &["--pitch-mm", "--step-mm", "--overscan-mm", "--angle-deg", "--line-origin-mm"],
        &[],
        &["--pitch-mm=1", "--step-mm=1"],
    ),
    (
        "maze",
        &["--pitch-mm", "--step-mm", "--overscan-mm", "--straightness", "--corner-radius-mm"],
        &["--seed"],
        &["--pitch-mm=1"],
    ),
    (
        "random-adaptive",
        &["--pitch-mm", "--step-mm", "--overscan-mm", "--contrast"],
        &["--seed", "--rounding-passes"],
        &["--pitch-mm=1"],
    ),
    (
        "multi-pitch",
        &[
            "--max-velocity-mm-per-s",
            "--min-pitch-mm",
            "--max-pitch-mm",
            "--min-area-mm2",
            "--step-mm",
            "--overscan-mm",
        ],
        &["--classes"],
        &["--max-velocity-mm-per-s=20", "--step-mm=1"],
    ),
    (
        "spiral",
        &["--pitch-mm", "--step-mm", "--overscan-mm"],
        &[],
        &["--pitch-mm=1", "--step-mm=1"],
    ),
];

/// Returns `needs` without the flag under test.
fn without<'a>(needs: &[&'a str], flag: &str) -> Vec<&'a str> {
    needs.iter().copied().filter(|n| n.split('=').next() != Some(flag)).collect()
}

#[test]
fn no_flag_of_a_path_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    for (method, flags, counts, needs) in CASES {
        for (flags, values) in [(flags, &FLOATS[..]), (counts, &COUNTS[..])] {
            for flag in flags {
                let base = [method, "--surface=surface", "--tif=tif", OUT];
                let arguments = [&base[..], &without(needs, flag)].concat();
                every_value(BINARY, tmp.path(), &arguments, &[flag], values, "out");
            }
        }
    }
    for value in FLOATS {
        let (pitch, step) = (format!("--pitch-mm={value}"), format!("--step-mm={value}"));
        for more in [[pitch.as_str(), "--step-mm=1"], ["--pitch-mm=1", step.as_str()]] {
            let base = ["random-adaptive", "--construction=tour", "--surface=surface", OUT];
            let arguments = [&base[..], &["--overscan-mm=2"], &more].concat();
            survives(BINARY, tmp.path(), &arguments, "out");
        }
    }
}

#[test]
fn no_map_and_no_tool_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    let [maps, tifs, _] = inputs(tmp.path());
    for (method, _, _, needs) in CASES {
        for (map, tif) in
            maps.iter().map(|m| (*m, "tif")).chain(tifs.iter().map(|t| ("surface", *t)))
        {
            let (map, tif) = (format!("--surface={map}"), format!("--tif={tif}"));
            let arguments = [&[method, map.as_str(), tif.as_str(), OUT][..], needs].concat();
            survives(BINARY, tmp.path(), &arguments, "out");
            // Without a TIF nothing but the method itself looks at the map.
            if method != "multi-pitch" {
                let arguments = [&[method, map.as_str(), "--overscan-mm=0.5", OUT], needs].concat();
                survives(BINARY, tmp.path(), &arguments, "out");
            }
        }
    }
}

#[test]
fn mistaken_units_are_refused_by_name() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    for (surface, tif, said) in [
        ("axes-in-metres", "tif-in-metres", "axes in metres?"),
        ("axes-in-metres", "tif", "a map in metres"),
        ("surface", "tif-in-metres", "a TIF in metres"),
        ("surface", "tif-in-um", "a TIF in um"),
        ("surface", "tif-from-zero", "coordinates of an array?"),
        ("surface", "tif-in-m-per-s", "rates in m/s"),
        ("marked", "tif", "a marker of invalid pixels?"),
        ("in-metres", "tif", "heights in metres?"),
    ] {
        let (surface, tif) = (format!("--surface={surface}"), format!("--tif={tif}"));
        let arguments = ["raster", &surface, &tif, "--pitch-mm=1", "--step-mm=1", OUT];
        let (code, message) = survives(BINARY, tmp.path(), &arguments, "out");
        assert_eq!(code, 2, "{arguments:?}: {message}");
        assert!(message.contains(said), "{said}: {message}");
    }
}

#[test]
fn any_path_can_be_inspected_and_drawn() {
    let tmp = tempfile::tempdir().unwrap();
    let [_, _, paths] = inputs(tmp.path());
    for path in paths {
        let path = format!("--tool-path={path}");
        let arguments = ["inspect", &path, "--surface=surface", "--machine=machine.json"];
        let (code, said) = survives(BINARY, tmp.path(), &arguments, "nothing");
        assert_eq!(code, 0, "{said}");
        survives(BINARY, tmp.path(), &["draw", &path, "--out=path.svg"], "path.svg");
    }
}
