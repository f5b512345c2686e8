//! Tests of the program `planish-campaign` from its flags to its files and exit codes.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_testkit::program::{text, write};
use planish_types::{Axis, Grid, Surface};
use serde_json::{Value, json};

fn run(dir: &Path, arguments: &str) -> Output {
    planish_testkit::program::stage("planish-campaign")
        .current_dir(dir)
        .args(arguments.split_whitespace())
        .output()
        .unwrap()
}

#[track_caller]
fn said(output: &Output, code: i32) -> String {
    let all = text(&output.stdout) + &text(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{all}");
    all
}

fn mirror() -> Surface {
    let axis = |n| Axis::new(0.0, 0.25, n).unwrap();
    let grid = Grid { x: axis(40), y: axis(30) };
    let mut height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        5.0 * (0.2 * c as f64).sin() + (0.3 * r as f64).cos()
    });
    height[[4, 7]] = f64::NAN;
    Surface::new(grid, height).unwrap()
}

fn process(dir: &Path) {
    let noise = json!({ "kind": "map_noise", "size": 0.4, "unit": "nm", "distribution": "normal", "note": "" });
    let file = json!({ "name": "test", "errors": [noise] });
    fs::write(dir.join("error_budget.json"), file.to_string()).unwrap();
}

fn manifest(artifact: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(artifact.join("manifest.json")).unwrap()).unwrap()
}

#[test]
fn a_measurement_has_the_noise_of_the_process_and_its_own_for_every_run() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "mirror", &mirror());
    process(dir);
    let command = "measure --surface mirror --error-budget error_budget.json --seed 3";
    said(&run(dir, &format!("{command} --out a")), 0);
    said(&run(dir, &format!("{command} --run-number 1 --out b")), 0);
    said(&run(dir, &format!("{command} --run-number 2 --out c")), 0);
    let map =
        |name: &str| planish_handoff::artifact::read::<Surface>(&dir.join(name)).unwrap().value;
    let error = |name: &str| -> Vec<f64> {
        let difference = map(name).height_nm() - mirror().height_nm();
        difference.iter().copied().filter(|v| !v.is_nan()).collect()
    };
    assert_eq!(error("a"), error("b"));
    let (b, c) = (error("b"), error("c"));
    assert_eq!(b.len(), 1199);
    let dot = |u: &[f64], v: &[f64]| u.iter().zip(v).map(|(a, b)| a * b).sum::<f64>() / 1199.0;
    // 1199 pixels: a variance scatters by sqrt(2 / 1199) = 4 %, a correlation by 3 %; three of each.
    assert!((dot(&b, &b) / 0.16 - 1.0).abs() < 0.13 && (dot(&b, &c) / 0.16).abs() < 0.09);
    let message = said(&run(dir, &format!("{command} --run-number 0 --out d")), 2);
    assert!(message.contains("run: is 0; give 1 to 1000000"), "{message}");
    let message = said(&run(dir, "measure --surface mirror --error-budget none.json --out d"), 2);
    assert!(message.contains("none.json") && !dir.join("d").exists(), "{message}");
}

#[test]
fn what_is_no_campaign_is_refused_and_nothing_is_written() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "mirror", &mirror());
    fs::create_dir_all(dir.join("campaign/learning/1")).unwrap();
    for (command, message) in [
        ("report campaign --surface mirror --runs 1 --out out", "campaign/learning/1/truth"),
        ("report campaign --surface mirror --runs 0 --out out", "--runs: is 0; give 1 to 100"),
        ("report campaign --surface mirror --runs 101 --out out", "--runs: is 101"),
        ("spread mirror", "mirror"),
        ("spread", "REPORTS"),
        ("decide --surface mirror --trajectory none --tolerance none --out out", "none"),
    ] {
        let words = said(&run(dir, command), 2);
        assert!(words.contains(message), "{command}: {words}");
        assert!(!dir.join("out").exists(), "{command}");
    }
}

/// Runs a program of the workspace beside this one.
fn program(dir: &Path, command: &str) {
    let mut words = command.split_whitespace();
    let name = format!("planish-{}", words.next().unwrap());
    let output =
        planish_testkit::program::stage(&name).args(words).current_dir(dir).output().unwrap();
    assert!(matches!(output.status.code(), Some(0 | 1)), "{command}: {}", text(&output.stderr));
}

/// Checks a campaign of one run, in which every chain runs the same plan: its numbers, its page and its decision.
#[test]
fn a_decision_and_a_page_say_what_the_artifacts_say() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let fixtures = planish_testkit::workspace().join("fixtures");
    fs::copy(fixtures.join("coupon.json"), dir.join("coupon.json")).unwrap();
    fs::copy(fixtures.join("machines/ion-beam.json"), dir.join("machine.json")).unwrap();
    let error = |kind: &str, size: f64, unit: &str| {
        json!({ "kind": kind, "size": size, "unit": unit,
        "distribution": "normal", "note": "<b>note</b>" })
    };
    let errors = [error("rate_scale", 3.0, "%"), error("map_noise", 0.2, "nm")];
    let file = json!({ "name": "test", "errors": errors });
    fs::write(dir.join("error_budget.json"), file.to_string()).unwrap();
    program(dir, "fixture coupon.json --out made");
    let mirror = "--surface made/surface --tif made/tif";
    program(dir, &format!("toolpath raster {mirror} --pitch-mm 2 --step-mm 2 --out path"));
    program(dir, &format!("dwell bounded-least-squares {mirror} --tool-path path --out dwell"));
    program(dir, "schedule pvt --tool-path path --dwell dwell --machine machine.json --out motion");
    let machine =
        format!("simulate --trajectory motion {mirror} --error-budget error_budget.json --seed 4");
    for (at, k, known) in [
        ("learning/1", 1, ""),
        ("without/1", 1, ""),
        ("known/1", 1, "--known"),
        ("alike/learning", 2, ""),
        ("alike/without", 2, ""),
        ("alike/known", 2, "--known"),
    ] {
        let at = format!("c/{at}");
        fs::create_dir_all(dir.join(&at)).unwrap();
        program(
            dir,
            &format!(
                "{machine} --run-number {k} {known} --measured-out {at}/measured --out {at}/truth"
            ),
        );
    }
    program(
        dir,
        "reconcile --before made/surface --after c/learning/1/measured --trajectory motion --tif made/tif \
         --fit rate_scale --out c/learning/1/reconciliation",
    );
    program(
        dir,
        &format!(
            "tolerance --trajectory motion {mirror} --error-budget error_budget.json --draws 1000 --out tolerance"
        ),
    );
    let decide = "decide --surface made/surface --trajectory motion --tolerance tolerance";
    let words = said(&run(dir, &format!("{decide} --out c/learning/1/decision")), 0);
    assert!(words.contains("RUN AGAIN: half of the runs would gain"), "{words}");
    let message = said(&run(dir, &format!("{decide} --least-gain-percent 101 --out no")), 2);
    assert!(message.contains("least_gain_percent: is 101"), "{message}");
    // What the numbers are made of
    let (decision, tolerance) =
        (manifest(&dir.join("c/learning/1/decision")), manifest(&dir.join("tolerance")));
    let (decision, tolerance) = (&decision["outcome"], &tolerance["outcome"]);
    let number = |v: &Value| v.as_f64().unwrap();
    // The noise of 0.2 nm but for its mean over 3969 pixels
    assert!((number(&decision["noise_rms_nm"]) - 0.2).abs() < 1e-4);
    let noise = &tolerance["errors"][1];
    let median = number(&tolerance["residual"]["median_nm"]).powi(2)
        - 2.0 * number(&noise["unreached_rms_nm"]).powi(2);
    // The same numbers in another order: rounding, which a difference of squares enlarges.
    assert!((number(&decision["next"]["median_nm"]) - median.sqrt()).abs() < 1e-9, "{decision}");
    let other = "decide --surface made/surface --trajectory motion --tolerance tolerance --out no";
    write(dir, "other", &self::mirror());
    let message = said(&run(dir, &other.replace("made/surface", "other")), 2);
    assert!(
        message.contains("--tolerance was made from another surface than --surface other"),
        "{message}"
    );

    let words = said(
        &run(dir, "report c --surface made/surface --runs 1 --mirror <coupon> --out report"),
        0,
    );
    assert!(words.contains("another mirror like it") && words.contains("rate_scale, %"), "{words}");
    let page = fs::read_to_string(dir.join("report/campaign.html")).unwrap();
    assert!(page.contains("Campaign on &lt;coupon&gt;") && !page.contains("<coupon>"), "{page}");
    assert!(page.contains("run again") && page.contains("<svg"), "{page}");
    let campaign = manifest(&dir.join("report"));
    let truth = manifest(&dir.join("c/learning/1/truth"));
    assert_eq!(campaign["outcome"]["runs"][0]["learning"]["rms_nm"], truth["outcome"]["rms_nm"]);
    // A row per chain, of the run and of the mirror like it; the first has the number of the manifest.
    let rows = fs::read_to_string(dir.join("report/campaign.csv")).unwrap();
    assert_eq!(rows.lines().count(), 1 + 2 * 3, "{rows}");
    let rms_nm = rows.lines().nth(1).and_then(|row| row.strip_prefix("1,learning,"));
    let rms_nm = rms_nm.and_then(|row| row.split(',').next()).expect("the first row");
    assert_eq!(rms_nm.parse(), Ok(number(&truth["outcome"]["rms_nm"])), "{rows}");
    let rate = &campaign["outcome"]["runs"][0]["parameters"][0];
    let hidden = number(&truth["outcome"]["hidden"]["truth"]["rate_scale"]);
    // Rounding of a product.
    assert!((number(&rate["truth"]) - 100.0 * hidden).abs() < 1e-12, "{rate}");
    let words = said(&run(dir, "spread report"), 0);
    assert!(words.contains("1 campaigns of 1 runs"), "{words}");

    // Another machine, or another run, in the place of one
    let at = "c/known/1";
    program(dir, &format!("{machine} --measured-out {at}/measured --out {at}/truth --force"));
    let message = said(&run(dir, "report c --surface made/surface --runs 1 --out no"), 2);
    assert!(
        message.contains("known/1/truth: is not run 1 of a machine that is known"),
        "{message}"
    );
    let machine = machine.replace("--seed 4", "--seed 5");
    program(
        dir,
        &format!("{machine} --known --measured-out {at}/measured --out {at}/truth --force"),
    );
    let message = said(&run(dir, "report c --surface made/surface --runs 1 --out no"), 2);
    assert!(message.contains("is of another machine than the runs before it"), "{message}");
    assert!(!dir.join("no").exists());
}
