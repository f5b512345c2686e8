//! A campaign of two runs on the fixture coupon, through the programs, as `just campaign` runs them, with
//! plans of few lines: parameters that are learnt from the first run improve the second.

use std::{fs, path::Path};

use planish_testkit::{program::text, workspace};
use serde_json::Value;

/// Runs `planish-<command>` in `dir`; no argument contains a space. A negative verdict is a result.
fn run(dir: &Path, command: &str) {
    let mut words = command.split_whitespace();
    let program = format!("planish-{}", words.next().unwrap());
    let output =
        planish_testkit::program::stage(&program).args(words).current_dir(dir).output().unwrap();
    let code = output.status.code();
    assert!(matches!(code, Some(0 | 1)), "planish-{command}: {}", text(&output.stderr));
}

fn outcome(dir: &Path, artifact: &str) -> Value {
    let text = fs::read_to_string(dir.join(artifact).join("manifest.json")).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["outcome"].clone()
}

/// A plan for the map `map` with the tool `tif`, in `to`: its motion is `to/trajectory`.
fn plan(dir: &Path, map: &str, tif: &str, to: &str) {
    run(dir, &format!("surface prepare --surface {map} --level piston --out {to}-map"));
    let mirror = format!("--surface {to}-map --tif {tif}");
    run(dir, &format!("toolpath raster {mirror} --pitch-mm 1 --step-mm 1 --out {to}-path"));
    run(
        dir,
        &format!(
            "refine {mirror} --tool-path {to}-path --machine machine.json --min-dwell-s 0.1 --out {to}"
        ),
    );
}

/// A run of the machine of seed 7: `to-measured` and `to-truth`; what is truly left, nm RMS.
fn machine_runs(dir: &Path, map: &str, motion: &str, more: &str, to: &str) -> f64 {
    run(
        dir,
        &format!(
            "simulate --trajectory {motion} --tif made/tif --surface {map} --error-budget hidden.json --seed 7 {more} \
             --measured-out {to}-measured --out {to}-truth"
        ),
    );
    outcome(dir, &format!("{to}-truth"))["rms_nm"].as_f64().unwrap()
}

#[test]
fn the_second_run_leaves_with_learning_what_a_known_tool_leaves() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let fixtures = workspace().join("fixtures");
    for (from, to) in [
        ("coupon.json", "coupon.json"),
        ("error-budgets/hidden.json", "hidden.json"),
        ("machines/ion-beam.json", "machine.json"),
    ] {
        fs::copy(fixtures.join(from), dir.join(to)).unwrap();
    }
    run(dir, "fixture coupon.json --out made");
    let measure = "campaign measure --surface made/surface --error-budget hidden.json --seed 7";
    run(dir, &format!("{measure} --out map-1"));
    plan(dir, "map-1", "made/tif", "first");
    let blind = machine_runs(dir, "map-1", "first/trajectory", "--run-number 1", "blind");
    run(
        dir,
        "reconcile --before map-1 --after blind-measured --trajectory first/trajectory --tif made/tif \
         --error-budget hidden.json --out learnt --corrected-tif tif --corrected-transform place \
         --learnt-error-budget error_budget.json",
    );

    // Another mirror like the first is the second run of this machine.
    run(dir, &format!("{measure} --run-number 2 --out map-2"));
    plan(dir, "map-2", "made/tif", "untaught");
    plan(dir, "map-2", "tif", "taught");
    run(dir, "register apply --transform place --trajectory taught/trajectory --out commanded");
    let known =
        machine_runs(dir, "map-2", "untaught/trajectory", "--run-number 2 --known", "known");
    let without = machine_runs(dir, "map-2", "untaught/trajectory", "--run-number 2", "without");
    let learning = machine_runs(dir, "map-2", "commanded", "--run-number 2", "learning");
    println!(
        "{blind:.4} nm after the first run; the second leaves {learning:.4} nm with learning, {without:.4} nm without, \
         {known:.4} nm with a tool that is known"
    );
    // One run teaches the tool to within its noise, which adds 0.17 nm as squares to the 0.32 nm of this plan: 1.13 times
    // with this seed. Without learning it is 1.8 times, so that nothing else gives it. Regression bound.
    assert!(learning <= 1.15 * known, "{learning} {known}");
    assert!(without > 1.4 * known, "{without} {known}");
    // Each half of what was learnt is needed: the tool alone, or the place alone, is not enough.
    let tool_alone = machine_runs(dir, "map-2", "taught/trajectory", "--run-number 2", "tool");
    run(dir, "register apply --transform place --trajectory untaught/trajectory --out placed");
    let place_alone = machine_runs(dir, "map-2", "placed", "--run-number 2", "place");
    assert!(tool_alone > 1.1 * known && place_alone > 1.1 * known, "{tool_alone} {place_alone}");

    // The first mirror again: the decision on another run, and its residual.
    plan(dir, "blind-measured", "tif", "second");
    let mirror = "--surface second-map --trajectory second/trajectory";
    run(
        dir,
        &format!("tolerance {mirror} --tif tif --error-budget error_budget.json --out tolerance"),
    );
    run(dir, &format!("campaign decide {mirror} --tolerance tolerance --out decision"));
    let decision = outcome(dir, "decision");
    assert_eq!(decision["verdict"], "run_again", "{decision}");
    run(dir, "register apply --transform place --trajectory second/trajectory --out again");
    let left = machine_runs(dir, "blind-measured", "again", "--run-number 2", "again");
    // The mirror now, to three standard errors; the next run, within the interval of 95 % and a little (docs/campaign.md:
    // in 20 campaigns on this mirror all are in it).
    let number = |key: &str| decision[key].as_f64().unwrap();
    let off = (number("now_rms_nm") - blind).abs();
    assert!(off < 3.0 * number("now_standard_error_nm"), "{decision} {blind}");
    let [low, high] =
        [0, 1].map(|k| decision["next"]["interval_95_percent_nm"][k].as_f64().unwrap());
    assert!((0.95 * low..1.05 * high).contains(&left), "{left} {decision}");
    // If everything were believed to be noise, the gain would be 0.
    assert!(number("gain_median_nm") > 0.1 && left < 0.6 * blind, "{decision} {left}");
}
