//! The program from end to end: TIFs from maps, their preparation, and the second names of the commands.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::{artifact, npy::ArrayData};
use planish_testkit::program::{save, stage, text, write};
use planish_types::Tif;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    surface_cli::{array, manifest, write_tif},
    tool_varying::{disk, spot},
};

fn call(dir: &Path, arguments: &[&str]) -> Output {
    stage("planish-tool").current_dir(dir).args(arguments).output().unwrap()
}

/// Runs, expects exit code 0, returns what was printed and what was warned of.
fn done(dir: &Path, arguments: &[&str]) -> (String, String) {
    let output = call(dir, arguments);
    let (said, warned) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {said}{warned}");
    (said, warned)
}

/// Runs, expects exit code 2, one error and nothing written; returns what was printed.
fn refused(dir: &Path, arguments: &[&str]) -> String {
    let output = call(dir, &[arguments, &["--out", "refused"]].concat());
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
    let errors = said.lines().filter(|line| line.starts_with("error: ")).count();
    assert!(output.stdout.is_empty() && errors == 1, "{said}");
    assert!(!dir.join("refused").exists(), "{arguments:?}");
    said
}

#[test]
fn a_tif_from_rates_and_from_a_spot() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let spot = |depth: f64, x0: f64| {
        Array2::from_shape_fn((41, 61), |(r, c)| {
            let (x, y) = (0.1 * c as f64 - 3.0 - x0, 0.1 * r as f64 - 2.0);
            depth * (-(x * x + y * y) / 0.5).exp()
        })
    };
    let save = |name: &str, map: Array2<f64>| {
        fs::write(dir.join(name), ArrayData::F64(map.into_dyn().into()).to_npy()).unwrap();
    };
    save("rate.npy", spot(8e-9, 0.0));
    done(
        dir,
        &["from-maps", "rate.npy", "--rate", "--unit", "m", "--pixel-mm", "0.1", "--out", "rate"],
    );
    let tif = artifact::read::<Tif>(&dir.join("rate")).unwrap().value;
    // The middle is the origin.
    assert!((tif.grid().x.start_mm() + 3.0).abs() < 1e-12);
    // Rounding.
    assert!((tif.peak_nm_per_s() - 8.0).abs() < 1e-12);

    save("after.npy", -spot(240.0, 0.5));
    save("before.npy", Array2::zeros((41, 61)));
    let base = ["from-maps", "after.npy", "--unit", "nm", "--pixel-mm", "0.1", "--dwell-s", "30"];
    let more = ["--half-size-mm", "1.5", "--before", "before.npy", "--out", "spot"];
    let (said, _) = done(dir, &[&base[..], &more].concat());
    assert!(said.contains("noise"), "{said}");
    let loaded = artifact::read::<Tif>(&dir.join("spot")).unwrap();
    // Plane fitted outside the square: the tail there is 240 exp(-4.5) = 2.7 nm at its edge.
    assert!((loaded.value.peak_nm_per_s() - 8.0).abs() < 0.05);
    let spot = &loaded.manifest.unwrap().outcome["spot"];
    // As above, a plane through the tail. Regression bound: 1.5e-3 mm was seen.
    assert!((spot["centre_mm"][0].as_f64().unwrap() - 3.5).abs() < 1e-2, "{spot}");

    // Directories of maps are read as maps.
    let nm = ["--unit", "nm", "--pixel-mm", "0.1"];
    for name in ["after", "before"] {
        let file = format!("{name}.npy");
        let flags = [&["surface", &file, "--out", name], &nm[..]].concat();
        let read = stage("planish-import").current_dir(dir).args(flags).output().unwrap();
        assert_eq!(read.status.code(), Some(0), "{read:?}");
    }
    let base =
        ["from-maps", "after", "--before", "before", "--dwell-s", "30", "--half-size-mm", "1.5"];
    done(dir, &[&base[..], &["--out", "spot-2"]].concat());
    let again = artifact::read::<Tif>(&dir.join("spot-2")).unwrap().value;
    assert_eq!(again.rate_nm_per_s(), loaded.value.rate_nm_per_s());

    assert!(
        refused(dir, &["from-maps", "rate.npy", "--rate", "--unit", "m"]).contains("--pixel-mm")
    );
    let added = ["from-maps", "after.npy", "--unit", "nm", "--pixel-mm", "0.1", "--rate"];
    assert!(refused(dir, &added).contains("no positive rate"));
}

#[test]
fn a_spot_with_noise_becomes_a_tif_without_bias() {
    // A Gaussian of 300 nm and 1 mm of full width, half size 1.6 mm, and normal noise (sums of twelve) of 1 % of its
    // peak.
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let mut random = ChaCha8Rng::seed_from_u64(41);
    let depth = Array2::from_shape_fn((101, 101), |(r, c)| {
        let square = (0.05 * (r as f64 - 50.0)).powi(2) + (0.05 * (c as f64 - 50.0)).powi(2);
        let normal = (0..12).map(|_| random.random_range(0.0..1.0)).sum::<f64>() - 6.0;
        300.0 * (-4.0 * std::f64::consts::LN_2 * square).exp() + 3.0 * normal
    });
    fs::write(dir.join("depth.npy"), ArrayData::F64(depth.into_dyn().into()).to_npy()).unwrap();
    let base = ["from-maps", "depth.npy", "--unit", "nm", "--pixel-mm", "0.05", "--dwell-s", "30"];
    let vrr = |out: &str, more: &[&str]| {
        done(dir, &[&base[..], &["--half-size-mm", "1.6", "--out", out], more].concat());
        artifact::read::<Tif>(&dir.join(out)).unwrap().value.vrr_nm_mm2_per_s()
    };
    let (plain, clipped) = (vrr("plain", &[]), vrr("clipped", &["--clip-negative"]));
    // 10 nm/s pi / (4 ln 2) mm^2; noise of 0.1 nm/s over 65 x 65 samples of 0.05 mm scatters by 0.016, and by as much
    // in the plane outside: 0.2 % of it, three of them.
    let expected = 10.0 * std::f64::consts::PI / (4.0 * std::f64::consts::LN_2);
    assert!((plain / expected - 1.0).abs() < 6e-3, "{plain} {expected}");
    // Sums round.
    assert!((clipped / plain - 1.0).abs() < 1e-12, "{clipped} {plain}");
}

/// Returns a map of rates as CSV: a spot of 5 nm/s and sigma 2 mm in a field of 41 mm, with a baseline.
fn rates(baseline: impl Fn(f64, f64) -> f64) -> String {
    let mut text = String::from("# unit: nm\n# pixel size: 1 mm\n");
    for r in -20..=20 {
        let row = (-20..=20).map(|c| {
            let (x, y) = (f64::from(c), f64::from(r));
            format!("{:.4}", 5.0 * (-0.125 * (x * x + y * y)).exp() + baseline(x, y))
        });
        text.push_str(&row.collect::<Vec<_>>().join(","));
        text.push('\n');
    }
    text
}

#[test]
fn a_low_baseline_is_doubted_by_its_volume_and_the_remedy_is_named() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    type Baseline = fn(f64, f64) -> f64;
    let cases: [(&str, Baseline, &str); 5] = [
        ("level", |_, _| 0.045, "is 38 % of its volume"),
        ("below", |_, _| -0.045, "takes off 151 % of its volume"),
        ("tilted", |x, _| 0.00225 * x, "moves 30 % of its volume"),
        ("round", |x, y| if x.hypot(y) < 19.0 { 0.045 } else { 0.0 }, "is 29 % of its volume"),
        ("none", |_, _| 0.0, ""),
    ];
    for (name, baseline, expected) in cases {
        fs::write(dir.join("tif.csv"), rates(baseline)).unwrap();
        let (_, warned) = done(dir, &["from-maps", "tif.csv", "--rate", "--out", name]);
        assert_eq!(
            warned.contains("a baseline?") || warned.contains("a tilted baseline?"),
            !expected.is_empty()
        );
        assert!(warned.contains(expected), "{name}: {warned}");
        let manifest = artifact::read::<Tif>(&dir.join(name)).unwrap().manifest.unwrap();
        let doubts = manifest.outcome["doubts"].as_array().unwrap().len();
        assert_eq!(doubts, usize::from(!expected.is_empty()), "{name}");
        if ["level", "below"].contains(&name) {
            // 2 pi sigma^2 5 nm/s, which planish-tool prepare --subtract-border gives.
            assert!(
                warned.contains("--subtract-border takes it off, and leaves 125.66 of"),
                "{warned}"
            );
        }
    }
    // The depth of a spot after 10 s, of which nothing is subtracted.
    fs::write(dir.join("depth.csv"), rates(|_, _| 0.045)).unwrap();
    let spot =
        ["from-maps", "depth.csv", "--dwell-s", "10", "--half-size-mm", "18", "--baseline", "none"];
    let (_, warned) = done(dir, &[&spot[..], &["--out", "spot"]].concat());
    assert!(warned.contains("a baseline?"), "{warned}");
}

#[test]
fn a_noisy_tif_goes_through_its_remedies_without_bias() {
    // The TIF with normal noise (sums of twelve) of 2 % of its peak and a pedestal of 5 %.
    let tmp = tempfile::tempdir().unwrap();
    write_tif(&tmp.path().join("clean"));
    write_tif(&tmp.path().join("tif"));
    let clean = array(&tmp.path().join("clean"), "rate_nm_per_s");
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut normal = || (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0;
    let noisy = clean.mapv(|v| v + 0.25 + 0.1 * normal());
    save(&tmp.path().join("tif"), "rate_nm_per_s", noisy);
    let arguments = "prepare --tif tif --subtract-border --taper-fraction 0.15 --out out";
    let output = call(tmp.path(), &arguments.split_whitespace().collect::<Vec<_>>());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let volume = array(&tmp.path().join("out"), "rate_nm_per_s").sum() / clean.sum();
    // The mean of 136 border samples errs by 0.0086 nm/s, over 1200 samples 10 of a sum of 246: 4 %, two of them.
    // Clipping at zero would add 0.4 x 0.1 nm/s on some 900 samples, 15 %.
    assert!((volume - 1.0).abs() < 0.08, "{volume}");
    // The result is a TIF that the next stage reads.
    let arguments = "prepare --tif out --centre centroid --out again";
    let output = call(tmp.path(), &arguments.split_whitespace().collect::<Vec<_>>());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
}

#[test]
fn a_tool_is_centred_turned_resampled_and_fitted() {
    let tmp = tempfile::tempdir().unwrap();
    write_tif(&tmp.path().join("tif"));
    let line = "prepare --tif tif --centre centroid --rotate-deg 90 --pixel-mm 0.2 --fit-formula gaussian --out out";
    let output = call(tmp.path(), &line.split_whitespace().collect::<Vec<_>>());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let outcome = &manifest(&tmp.path().join("out"))["outcome"];
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    assert!((number(&outcome["centre_mm"][0]) - 0.4).abs() < 1e-5, "{outcome}");
    assert!((number(&outcome["centre_mm"][1]) + 0.3).abs() < 1e-5, "{outcome}");
    assert_eq!(outcome["before"]["sample_at_centre"], false);
    assert_eq!(outcome["after"]["sample_at_centre"], true);
    let vrr = |when: &str| number(&outcome[when]["vrr_nm_mm2_per_s"]);
    // The volume is kept by a factor: rounding.
    assert!((vrr("after") / vrr("before") - 1.0).abs() < 1e-12);
    // 2 pi 5 0.49; the samples end at 4.4 sigma.
    assert!((vrr("before") / 15.3938 - 1.0).abs() < 1e-4, "{outcome}");
    let sigma = number(&outcome["fit"]["components"][0]["sigma_mm"][0]);
    assert!((sigma / 0.7 - 1.0).abs() < 5e-3, "{outcome}");

    let line = "prepare --tif tif --fit-formula super-gaussian --use-fit --out fitted";
    let output = call(tmp.path(), &line.split_whitespace().collect::<Vec<_>>());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let (a, b) = (
        array(&tmp.path().join("tif"), "rate_nm_per_s"),
        array(&tmp.path().join("fitted"), "rate_nm_per_s"),
    );
    assert!((a - b).iter().all(|d| d.abs() < 1e-6));
}

#[test]
fn a_tif_that_cannot_be_prepared_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    write_tif(&tmp.path().join("tif"));
    for (name, scale) in [("zero", 0.0), ("negative", -1.0)] {
        write_tif(&tmp.path().join(name));
        let rate = array(&tmp.path().join("tif"), "rate_nm_per_s") * scale;
        save(&tmp.path().join(name), "rate_nm_per_s", rate);
    }
    for (line, message) in [
        ("prepare --tif zero", "no positive rate"),
        ("prepare --tif negative", "no positive rate"),
        ("prepare --tif tif --pixel-mm 0", "is 0 mm"),
        ("prepare --tif tif --pixel-mm 50", "less than 2 samples"),
        ("prepare --tif tif --rotate-deg inf", "rotation: is inf"),
        ("prepare --tif tif --use-fit", "--fit-formula"),
    ] {
        let said = refused(tmp.path(), &line.split_whitespace().collect::<Vec<_>>());
        assert!(said.contains(message), "{line}: {said}");
    }
}

/// Returns the arrays of an artifact, by the names of their files.
fn arrays(dir: &Path) -> Vec<(String, Vec<u8>)> {
    let names = fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = names.filter(|name| name.ends_with(".npy")).collect();
    names.sort();
    names.into_iter().map(|name| (name.clone(), fs::read(dir.join(name)).unwrap())).collect()
}

/// Second name of a command, the command, and flags of both.
const NAMES: [(&str, &str, &str); 9] = [
    ("planish-import tif", "from-maps", "rates.csv --rate --unit nm --pixel-mm 0.25"),
    ("planish-surface tif", "prepare", "--tif spot --rotate-deg 30"),
    (
        "planish-surface tool-rate",
        "rate",
        "--tif spot --surface part --by x --table rates.txt --error 0.1",
    ),
    (
        "planish-surface tool-rate",
        "rate",
        "--tif spot --surface part --by incidence --sphere-radius-mm 36 --exponent=-1.7",
    ),
    (
        "planish-surface tool-spots",
        "spots",
        "--surface part --by x --spot=-20=spot --spot 20=spot --error 0.1",
    ),
    (
        "planish-surface tool-edge",
        "edge",
        "--tif spot --surface part --pad-radius-mm 4 --error 0.3",
    ),
    ("planish-surface tool-turned", "turned", "--tif spot --surface part --error 0.1"),
    (
        "planish-surface tool-footprint",
        "footprint",
        "--tif spot --surface part --direction fixed --sphere-radius-mm 36 --error 0.1",
    ),
    ("planish-surface tool-time", "time", "--tif spot --table warm-up.txt"),
];

#[test]
fn a_second_name_makes_the_same_arrays_and_records_itself() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "part", &disk(|_, _| 0.0));
    write(dir, "spot", &spot());
    fs::write(dir.join("rates.txt"), "-30 1\n0 1.2\n30 0.9\n").unwrap();
    fs::write(dir.join("warm-up.txt"), "0 0.8\n60 1\n").unwrap();
    fs::write(dir.join("rates.csv"), "0,1,0\n1,5,1\n0,1,0\n").unwrap();
    for (k, (second, command, flags)) in NAMES.into_iter().enumerate() {
        let (program, method) = second.split_once(' ').unwrap();
        let [old, new] = ["old", "new"].map(|name| format!("{name}{k}"));
        let flags: Vec<&str> = flags.split(' ').collect();
        let words = [&[method], &flags[..], &["--out", &old]].concat();
        let ran = stage(program).current_dir(dir).args(&words).output().unwrap();
        let (said, warned) = (text(&ran.stdout), text(&ran.stderr));
        assert!(matches!(ran.status.code(), Some(0 | 1)), "{second}: {warned}");
        let typed = program.replacen('-', " ", 1);
        assert!(said.lines().all(|line| line.starts_with(&format!("{typed}: "))), "{said}");
        let same = call(dir, &[&[command], &flags[..], &["--out", &new]].concat());
        assert_eq!(same.status.code(), ran.status.code(), "{}", text(&same.stderr));
        assert_eq!(text(&same.stdout), said.replace(&typed, "planish tool").replace(&old, &new));
        assert_eq!(text(&same.stderr), warned);
        let made = arrays(&dir.join(&old));
        assert!(made.len() > 2 && made == arrays(&dir.join(&new)), "{second}");
        let [of_old, of_new] = [&old, &new].map(|name| manifest(&dir.join(name)));
        assert_eq!([&of_old["tool"], &of_old["method"]], [program, method]);
        assert_eq!([&of_new["tool"], &of_new["method"]], ["planish-tool", command]);
        let recorded = of_old["command"].as_str().unwrap().replace('\'', "");
        assert_eq!(recorded, format!("{typed} {}", words.join(" ")));
        assert_eq!(
            [&of_old["settings"], &of_old["outcome"]],
            [&of_new["settings"], &of_new["outcome"]]
        );
        // The words that the setting `varying` of a pipeline had are words of the program, too.
        if program == "planish-surface" && method != "tif" {
            done(dir, &[&[method], &flags[..], &["--out", &new]].concat());
        }
    }
}

#[test]
fn the_incidence_has_a_command_of_its_own() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "part", &disk(|_, _| 0.0));
    write(dir, "spot", &spot());
    let flags =
        ["--tif", "spot", "--surface", "part", "--sphere-radius-mm", "36", "--exponent=-1.7"];
    done(dir, &[&["incidence"], &flags[..], &["--out", "own"]].concat());
    done(dir, &[&["rate", "--by", "incidence"], &flags[..], &["--out", "general"]].concat());
    assert_eq!(arrays(&dir.join("own")), arrays(&dir.join("general")));
    let manifest = manifest(&dir.join("own"));
    assert_eq!([&manifest["method"], &manifest["settings"]["by"]], ["incidence"; 2]);
}
