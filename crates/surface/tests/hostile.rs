//! Absurd numbers in every numeric flag, and maps that are hardly maps. The program must end in time with
//! an exit code of the table and at most one message, never with an internal error. It must write nothing
//! that is not a number.

use std::{collections::BTreeSet, fs, path::Path, process::Output, time::Duration};

use ndarray::{Array1, Array2, ArrayD};
use planish_testkit::program::{run_within, save};
use serde_json::Value;

/// Longest time for one run, s. Larger: the test finds an endless loop later. Smaller: it fails on a busy
/// machine. Chosen: a run on 12 x 9 pixels takes milliseconds.
const LIMIT: Duration = Duration::from_secs(20);

/// Absurd numbers that replace the `?` of a command, which runs with a usual number first.
const NUMBERS: [&str; 14] = [
    "0",
    "-0",
    "-1",
    "nan",
    "inf",
    "-inf",
    "1e-300",
    "1e-9",
    "1e9",
    "1e300",
    "1000000",
    "9007199254740993",
    "18446744073709551615",
    "99999999999999999999",
];

fn axis(n: usize, step: f64) -> ArrayD<f64> {
    Array1::from_iter((0..n).map(|i| step * (i as f64 - 0.5 * (n - 1) as f64))).into_dyn()
}

pub fn put(dir: &Path, name: &str, map: Array2<f64>, step: f64) {
    let (ny, nx) = map.dim();
    save(dir, name, map);
    save(dir, "x_mm", axis(nx, step));
    save(dir, "y_mm", axis(ny, step));
}

/// Returns the smooth map with a hole on which the flags are tried.
pub fn usual() -> Array2<f64> {
    let mut map =
        Array2::from_shape_fn((9, 12), |(r, c)| (0.7 * r as f64).sin() + 0.1 * (c * c) as f64);
    map[[2, 8]] = f64::NAN;
    map
}

/// Runs a command until it ends, or until [`LIMIT`].
fn run(stage: &str, dir: &Path, arguments: &[String]) -> Output {
    let mut command = planish_testkit::program::stage(stage);
    run_within(command.current_dir(dir).args(arguments), LIMIT)
}

/// Keys of the outcome that may be null, because there is nothing to report: steps that were not asked for,
/// the width of a TIF that does not fall to half of its peak, radii and ellipses of shapes that have none,
/// slopes over a base that does not fit along y, correlations that do not fall, and kernels of a tool that has
/// only a factor of the pixels.
const ABSENT: [&str; 20] = [
    ".outcome.shape.radius_m",
    ".outcome.shape.ellipse",
    ".outcome.slope_y",
    ".outcome.after[].shape.radius_m",
    ".outcome.after[].shape.ellipse",
    ".outcome.after[].slope_x_rms_nrad",
    ".outcome.after[].slope_y_rms_nrad",
    ".outcome.centre_line.slope_rms_nrad",
    ".outcome.autocorrelation_length_x_mm",
    ".outcome.autocorrelation_length_y_mm",
    ".outcome.strehl",
    ".outcome.specification",
    ".outcome.outliers",
    ".outcome.removed_low_order",
    ".outcome.filled",
    ".outcome.extended",
    ".outcome.before.fwhm_mm[]",
    ".outcome.after.fwhm_mm[]",
    ".outcome.fit",
    ".outcome.report",
];

/// Collects the places where a JSON value is null, because a number that JSON does not have becomes null.
fn nulls(value: &Value, at: String, found: &mut BTreeSet<String>) {
    match value {
        Value::Null => drop(found.insert(at)),
        Value::Array(all) => all.iter().for_each(|v| nulls(v, format!("{at}[]"), found)),
        Value::Object(all) => all.iter().for_each(|(k, v)| nulls(v, format!("{at}.{k}"), found)),
        _ => {}
    }
}

/// Runs a command into `out`. Returns what is wrong with its end, if anything, the nulls of its manifest,
/// and whether it ran.
fn judged(
    stage: &str,
    dir: &Path,
    arguments: &[String],
    out: &str,
) -> (Option<String>, BTreeSet<String>, bool) {
    let _ = fs::remove_dir_all(dir.join(out));
    let _ = fs::remove_file(dir.join(out));
    let output = run(stage, dir, &[arguments, &["--out".into(), out.into()]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let errors = said.lines().filter(|l| l.starts_with("error: ")).count();
    let mut found = BTreeSet::new();
    let wrong = match output.status.code() {
        _ if said.contains("internal error") || said.contains("panicked") => Some(said),
        Some(0 | 1) => {
            if let Ok(text) = fs::read_to_string(dir.join(out).join("manifest.json")) {
                let manifest: Value = serde_json::from_str(&text).unwrap();
                nulls(&manifest["outcome"], ".outcome".into(), &mut found);
                found.retain(|n| !ABSENT.contains(&n.as_str()));
            }
            let drawn = [dir.join(out), dir.join(out).join("psd.svg")];
            let drawn = drawn.iter().find_map(|p| fs::read_to_string(p).ok());
            drawn
                .filter(|svg| svg.contains("NaN") || svg.contains("inf"))
                .map(|_| "NaN drawn".into())
        }
        Some(2) if errors != 1 => Some(format!("{errors} messages: {said}")),
        Some(2) if dir.join(out).exists() => Some(format!("wrote: {said}")),
        Some(2) => None,
        other => Some(format!("ended with {other:?}: {said}")),
    };
    (wrong, found, output.status.code() != Some(2))
}

/// A subcommand, its flags with a `?` where a hostile number goes, and a number that is usual there.
const FLAGS: [(&str, &str, &str); 37] = [
    ("spec", "--base-mm ?", "1"),
    ("spec", "--band-per-mm ? 0.3", "0.1"),
    ("spec", "--band-per-mm 0.1 ?", "0.3"),
    ("spec", "--centre-line-width-mm ?", "1"),
    ("spec", "--wavelength-nm ?", "633"),
    ("spec", "--wavelength-nm 1 --grazing-mrad ?", "3"),
    ("spec", "--subtract ellipse --ellipse ? 900 3", "30000"),
    ("spec", "--subtract ellipse --ellipse 30000 ? 3", "900"),
    ("spec", "--subtract ellipse --ellipse 30000 900 ?", "3"),
    ("spec", "--subtract ellipse --ellipse 30000 900 3 --ellipse-pole-mm ?", "0"),
    ("spec", "--subtract ellipse --ellipse 30000 900 3 --ellipse-free q --ellipse-pole-mm ?", "0"),
    ("spec", "--memory-gib ?", "1"),
    ("prepare", "--level legendre --level-order ?", "3"),
    ("prepare", "--level zernike --level-order ?", "3"),
    ("prepare", "--level zernike --level-order 2 --zernike-circle-mm 0 0 ?", "9"),
    ("prepare", "--level zernike --level-order 2 --zernike-circle-mm ? 0 9", "0"),
    ("prepare", "--aperture-rectangle-mm -3 ? -3 3", "3"),
    ("prepare", "--aperture-rectangle-mm ? 3 -3 3", "-3"),
    ("prepare", "--aperture-circle-mm 0 0 ?", "3"),
    ("prepare", "--aperture-circle-mm 0 ? 3", "0"),
    ("prepare", "--mask-outliers --feature-mm ?", "2"),
    ("prepare", "--mask-outliers --feature-mm 2 --outlier-seed-sigmas ?", "10"),
    ("prepare", "--mask-outliers --feature-mm 2 --outlier-grow-sigmas ?", "2"),
    ("prepare", "--mask-outliers --feature-mm 2 --outlier-floor-nm ?", "1"),
    ("prepare", "--mask-outliers --feature-mm 2 --outlier-dilate-px ?", "1"),
    ("prepare", "--extend nearest --extend-mm ?", "2"),
    ("prepare", "--extend gaussian-decay --extend-mm 3 --extend-sigma-mm ?", "2"),
    ("prepare", "--extend gerchberg-papoulis --extend-mm 3 --extend-cutoff-per-mm ?", "0.2"),
    (
        "prepare",
        "--extend gerchberg-papoulis --extend-mm 3 --extend-cutoff-per-mm 0.2 --extend-iterations ?",
        "10",
    ),
    (
        "prepare",
        "--extend gerchberg-papoulis --extend-mm 3 --extend-cutoff-per-mm 0.2 --extend-tolerance-nm ?",
        "1",
    ),
    ("prepare", "--extend polynomial --extend-mm 3 --extend-order ? 2", "2"),
    ("psd", "--band-per-mm ? 0.3", "0.1"),
    ("psd", "--band-per-mm 0.1 ?", "0.3"),
    ("psd", "--memory-gib ?", "1"),
    ("prepare", "--extend nearest --extend-mm 2 --memory-gib ?", "1"),
    ("draw", "--section-y-mm ?", "0"),
    ("draw", "--memory-gib ?", "1"),
];

#[test]
fn absurd_numbers_end_with_a_result_or_a_message() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    put(&dir.join("map"), "height_nm", usual(), 1.0);
    try_numbers("planish-surface", dir, &FLAGS, |_| &["--surface", "map"]);
}

/// Tries every absurd number in every flag of `commands`, whose inputs are given by the subcommand.
pub fn try_numbers(
    stage: &str,
    dir: &Path,
    commands: &[(&str, &str, &str)],
    inputs: fn(&str) -> &'static [&'static str],
) {
    let mut failures = Vec::new();
    for (method, flags, usual) in commands {
        let with = |number: &str| -> Vec<String> {
            let flags = flags.split(' ').map(|f| f.replace('?', number));
            let input = inputs(method).iter().map(|s| (*s).to_owned());
            [(*method).to_owned()].into_iter().chain(input).chain(flags).collect()
        };
        let (wrong, found, ran) = judged(stage, dir, &with(usual), "out");
        assert!(
            wrong.is_none() && found.is_empty() && ran,
            "{method} {flags}: {wrong:?} {found:?}"
        );
        for number in NUMBERS {
            let arguments = with(number);
            let (wrong, found, _) = judged(stage, dir, &arguments, "out");
            if let Some(wrong) = wrong {
                failures.push(format!("{}: {wrong}", arguments.join(" ")));
            } else if !found.is_empty() {
                failures.push(format!("{}: null in {found:?}", arguments.join(" ")));
            }
        }
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

#[test]
fn maps_that_are_hardly_maps_end_with_a_result_or_a_message() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let calls: [&[&str]; 18] = [
        &["prepare"],
        &["prepare", "--level", "plane"],
        &["prepare", "--level", "legendre", "--level-order", "4"],
        &["prepare", "--level", "zernike", "--level-order", "4"],
        &["prepare", "--mask-outliers", "--feature-mm", "2"],
        &["prepare", "--mask-outliers", "--feature-mm", "2", "--fill"],
        &["prepare", "--fill"],
        &["prepare", "--extend", "nearest", "--extend-mm", "2"],
        &["prepare", "--extend", "gaussian-decay", "--extend-mm", "2"],
        &["prepare", "--extend", "polynomial", "--extend-mm", "2"],
        &[
            "prepare",
            "--extend",
            "gerchberg-papoulis",
            "--extend-mm",
            "2",
            "--extend-cutoff-per-mm",
            "0.2",
        ],
        &["psd"],
        &["psd", "--window", "none", "--detrend", "mean", "--band-per-mm", "0.1", "0.3"],
        &["spec"],
        &["spec", "--subtract", "sphere", "--base-mm", "0.3", "--wavelength-nm", "633"],
        &["spec", "--subtract", "cylinder-y", "--centre-line-width-mm", "1"],
        &["draw"],
        &["draw", "--section-y-mm", "0"],
    ];
    let ends = try_maps("planish-surface", dir, ["height_nm", "--surface"], &calls);
    assert!(ends.iter().all(|count| *count > 100), "done, refused: {ends:?}");
}

/// Runs every call on maps that are hardly maps, which are the array and the input `[array, flag]`. Returns how many
/// calls ended with a result, and with a message.
pub fn try_maps(
    stage: &str,
    dir: &Path,
    [array, flag]: [&str; 2],
    calls: &[&[&str]],
) -> [usize; 2] {
    let nan = f64::NAN;
    let mut one = Array2::from_elem((9, 12), nan);
    one[[4, 6]] = 3.0;
    let mut pair = one.clone();
    pair[[4, 7]] = 4.0;
    let mut row = Array2::from_elem((9, 12), nan);
    row.row_mut(3).iter_mut().enumerate().for_each(|(i, v)| *v = (i as f64).sin());
    let maps = [
        ("one-pixel", Array2::zeros((1, 1))),
        ("one-row", Array2::zeros((1, 12))),
        ("all-nan", Array2::from_elem((9, 12), nan)),
        ("one-valid-pixel", one),
        ("two-valid-pixels", pair),
        ("one-valid-row", row),
        ("constant", Array2::from_elem((9, 12), 7.0)),
        ("zero", Array2::zeros((9, 12))),
        ("large", Array2::from_elem((9, 12), 1e12)),
        (
            "jagged",
            Array2::from_shape_fn((9, 12), |(r, c)| if (r + c) % 2 == 0 { 1e12 } else { -1e12 }),
        ),
        ("small", Array2::from_shape_fn((9, 12), |(r, c)| 1e-300 * (r * c) as f64)),
        ("two-by-two", Array2::from_shape_fn((2, 2), |(r, c)| (r + c) as f64)),
    ];
    let mut failures = Vec::new();
    let (mut done, mut refused) = (0, 0);
    for step in [1.0, 1e-9, 1e5] {
        for (name, map) in &maps {
            put(&dir.join(name), array, map.clone(), step);
            for call in calls {
                let arguments = [&call[..1], &[flag, *name], &call[1..]].concat();
                let arguments: Vec<String> = arguments.into_iter().map(String::from).collect();
                let (wrong, found, ran) = judged(stage, dir, &arguments, "out");
                (done, refused) = (done + usize::from(ran), refused + usize::from(!ran));
                if let Some(wrong) = wrong {
                    failures.push(format!("{} (step {step}): {wrong}", arguments.join(" ")));
                } else if !found.is_empty() {
                    let problem = format!("null in {found:?}");
                    failures.push(format!("{} (step {step}): {problem}", arguments.join(" ")));
                }
            }
        }
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
    [done, refused]
}
