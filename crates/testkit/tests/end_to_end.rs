//! The coupon from its recipe to the summary, through the binaries.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
    process::Output,
};

use ndarray::{ArrayD, array};
use planish_handoff::npy::ArrayData;
use planish_testkit::workspace;
use serde_json::Value;
use tempfile::TempDir;

/// Name of the directory of a run, and the arguments of `planish-schedule` for it.
const METHODS: [(&str, &str); 4] = [
    ("position", "position"),
    ("constant-acceleration", "constant-acceleration"),
    ("pvt", "pvt --mode smooth"),
    ("pvt-monotone", "pvt --mode monotone"),
];

/// A directory in which the line is run by relative paths, so that two of them can be compared
/// byte by byte.
struct Line {
    dir: TempDir,
    threads: u32,
}

impl Line {
    fn new(threads: u32) -> Self {
        let dir = TempDir::new().unwrap();
        let fixtures = workspace().join("fixtures");
        fs::copy(fixtures.join("coupon.json"), dir.path().join("coupon.json")).unwrap();
        let machine = dir.path().join("machine.json");
        fs::copy(fixtures.join("machines/ion-beam-no-jerk-limit.json"), machine).unwrap();
        Self { dir, threads }
    }

    fn path(&self, relative: &str) -> PathBuf {
        self.dir.path().join(relative)
    }

    /// Runs `planish-<command>`; no argument contains a space.
    fn run(&self, command: &str) -> Output {
        let mut words = command.split_whitespace();
        planish_testkit::program::stage(&format!("planish-{}", words.next().unwrap()))
            .args(words)
            .current_dir(self.dir.path())
            .env("RAYON_NUM_THREADS", self.threads.to_string())
            .output()
            .unwrap()
    }

    /// Runs a stage that ends with the exit code `code`; returns what it says.
    fn expect(&self, code: i32, command: &str) -> String {
        let output = self.run(command);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "planish-{command}: {error}");
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    /// The whole line; returns what every stage says.
    fn whole(&self) -> Vec<String> {
        let mut said = vec![self.expect(0, "fixture coupon.json --out run/fixture")];
        said.extend(self.plan("run/fixture/surface", "run/fixture/tif", "run"));
        for (name, scheduler) in METHODS {
            said.extend(self.method(name, scheduler, "run/fixture/tif", "run"));
        }
        let report = "compare report run --pipeline raster --mirror coupon --out run/report";
        said.push(self.expect(0, report));
        said
    }

    /// Runs the stages from the map to the dwell times; returns what they say.
    fn plan(&self, map: &str, tif: &str, run: &str) -> Vec<String> {
        [
            format!("surface prepare --surface {map} --out {run}/surface"),
            format!(
                "toolpath raster --surface {run}/surface --tif {tif} --pitch-mm 1 --step-mm 1 \
                 --out {run}/tool_path"
            ),
            format!(
                "dwell bounded-least-squares --surface {run}/surface --tif {tif} \
                 --tool-path {run}/tool_path --min-dwell-s 0.1 --out {run}/dwell"
            ),
        ]
        .map(|command| self.expect(0, &command))
        .to_vec()
    }

    /// Runs the stages from the dwell times to the verdict; returns what they say.
    fn method(&self, name: &str, scheduler: &str, tif: &str, run: &str) -> Vec<String> {
        let dir = format!("{run}/methods/{name}");
        // Position mode jumps, so the schedule and the judge end with exit code 1.
        let verdict = i32::from(scheduler == "position");
        [
            (
                verdict,
                format!(
                    "schedule {scheduler} --tool-path {run}/tool_path --dwell {run}/dwell \
                     --machine machine.json --out {dir}/trajectory \
                     --wall-time {dir}/schedule-wall.json"
                ),
            ),
            (
                0,
                format!(
                    "simulate --trajectory {dir}/trajectory --tif {tif} --surface {run}/surface \
                     --out {dir}/removal --wall-time {dir}/simulate-wall.json"
                ),
            ),
            (
                verdict,
                format!(
                    "verify --trajectory {dir}/trajectory --machine machine.json \
                     --out {dir}/verdict"
                ),
            ),
        ]
        .map(|(code, command)| self.expect(code, &command))
        .to_vec()
    }

    fn json(&self, relative: &str) -> Value {
        serde_json::from_slice(&fs::read(self.path(relative)).unwrap()).unwrap()
    }

    /// The bytes of all files under `relative` by name; wall times and reports left out, which say
    /// how long the stages took.
    fn bytes(&self, relative: &str) -> BTreeMap<String, Vec<u8>> {
        let mut files = BTreeMap::new();
        collect(&self.path(relative), "", &mut files);
        files.retain(|name, _| !name.ends_with("-wall.json") && !name.starts_with("report/"));
        files
    }
}

fn collect(dir: &Path, prefix: &str, files: &mut BTreeMap<String, Vec<u8>>) {
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        let name = format!("{prefix}{}", path.file_name().unwrap().to_string_lossy());
        if path.is_dir() {
            collect(&path, &format!("{name}/"), files);
        } else {
            files.insert(name, fs::read(&path).unwrap());
        }
    }
}

/// Names of the files whose bytes differ, or that only one side has.
fn differences(a: &BTreeMap<String, Vec<u8>>, b: &BTreeMap<String, Vec<u8>>) -> Vec<String> {
    let names: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    names.into_iter().filter(|name| a.get(*name) != b.get(*name)).cloned().collect()
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_object().unwrap().keys().map(String::as_str).collect()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

#[test]
fn the_coupon_is_polished_and_the_summary_says_so() {
    let line = Line::new(2);
    line.whole();
    let summary = line.json("run/report/summary.json");

    // Exactly the keys that other programs read.
    assert_eq!(
        keys(&summary),
        [
            "answer",
            "pipeline",
            "fixture",
            "part",
            "tool",
            "initial",
            "slope_base_mm",
            "reach",
            "division",
            "specification",
            "error_budget",
            "without_motion",
            "methods",
            "left_out",
            "remarks",
            "best",
        ]
    );
    assert_eq!([&summary["pipeline"], &summary["fixture"]], ["raster", "coupon"]);
    assert_eq!(
        keys(&summary["initial"]),
        ["rms_nm", "pv_nm", "slope_rms_nrad", "short_wave_rms_nm", "zone_rms", "low_order"]
    );
    assert_eq!(keys(&summary["without_motion"]), ["rms_nm", "total_time_s"]);
    let methods = &summary["methods"];
    assert_eq!(keys(methods), METHODS.map(|(name, _)| name));
    for (name, _) in METHODS {
        assert_eq!(
            keys(&methods[name]),
            [
                "rms_nm",
                "pv_nm",
                "rms_detilted_nm",
                "slope_rms_nrad",
                "short_wave_rms_nm",
                "low_order",
                "total_time_s",
                "max_velocity_mm_per_s",
                "max_acceleration_mm_per_s2",
                "max_velocity_step_mm_per_s",
                "max_acceleration_step_mm_per_s2",
                "limits_respected",
                "broken_limits",
                "after_servo_rms_nm",
                "machine",
                "schedule_wall_s",
                "simulate_wall_s",
                "execution",
                "places",
                "plan",
                "specification",
                "remarks",
            ]
        );
    }

    // The recipe scales the map to 10 nm RMS. What the line cannot correct is the noise of
    // 0.05 nm and what is finer than the tool: far below a tenth.
    let initial = number(&summary["initial"]["rms_nm"]);
    assert!((initial - 10.0).abs() < 0.1, "{initial}");
    for (name, _) in METHODS {
        let m = &methods[name];
        println!("{name}: {m}");
        let rms = number(&m["rms_nm"]);
        // Regression bound: measured 0.46 nm at most on the coupon, of 10 nm.
        assert!(rms < 0.1 * initial, "{name}: {rms} of {initial} nm");
        assert!(number(&m["rms_detilted_nm"]) <= rms && rms < number(&m["pv_nm"]), "{name}");
    }
    assert_eq!(summary["without_motion"]["rms_nm"], methods["position"]["rms_nm"]);

    // The machine can do what PVT plans; it cannot jump.
    for name in ["pvt", "pvt-monotone"] {
        assert_eq!(methods[name]["limits_respected"], true, "{name}");
        for (key, limits) in
            [("max_velocity_mm_per_s", [250.0, 150.0]), ("max_acceleration_mm_per_s2", [2e3, 1e3])]
        {
            for axis in 0..2 {
                let value = number(&methods[name][key][axis]);
                assert!(value > 0.0 && value <= limits[axis], "{name}: {key} {value}");
            }
        }
    }
    assert_eq!(methods["position"]["limits_respected"], false);

    // According to the judge the monotone motion never leaves the box of a segment.
    let counts = |name: &str| {
        let verdict = line.json(&format!("run/methods/{name}/verdict/manifest.json"));
        let count = |axis: usize| verdict["outcome"]["axes"][axis]["overshoot_mm"]["count"].clone();
        [count(0), count(1)]
    };
    assert_eq!(counts("pvt-monotone"), [0, 0]);
    let smooth: u64 = counts("pvt").iter().map(|c| c.as_u64().unwrap()).sum();
    assert!(smooth > 0, "the smooth motion overshoots at the corners of the raster");
}

#[test]
fn a_second_run_does_nothing_and_changes_no_byte() {
    let line = Line::new(2);
    line.whole();
    let mut before = BTreeMap::new();
    collect(&line.path("run"), "", &mut before);
    let said = line.whole();
    for text in said {
        assert!(text.contains("unchanged, nothing to do"), "{text}");
    }
    let mut after = BTreeMap::new();
    collect(&line.path("run"), "", &mut after);
    assert_eq!(differences(&before, &after), Vec::<String>::new());
}

#[test]
fn one_thread_and_two_write_the_same_bytes() {
    let (one, two) = (Line::new(1), Line::new(2));
    one.whole();
    two.whole();
    let (a, b) = (one.bytes("run"), two.bytes("run"));
    // Two artifacts of the fixture, three of the plan, three of every method.
    let manifests = a.keys().filter(|name| name.ends_with("manifest.json")).count();
    assert_eq!(manifests, 2 + 3 + 3 * METHODS.len());
    assert_eq!(differences(&a, &b), Vec::<String>::new());
}

#[test]
fn bare_arrays_give_what_artifacts_give() {
    let line = Line::new(2);
    line.whole();
    // What a NumPy user makes: the arrays, and no manifest.
    for part in ["surface", "tif"] {
        let bare = line.path(&format!("bare/{part}"));
        fs::create_dir_all(&bare).unwrap();
        for (name, bytes) in line.bytes(&format!("run/fixture/{part}")) {
            if name.ends_with(".npy") {
                fs::write(bare.join(name), bytes).unwrap();
            }
        }
    }
    let output = line.run("surface prepare --surface bare/surface --out warned");
    let warning = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && warning.contains("no manifest.json"), "{warning}");

    line.plan("bare/surface", "bare/tif", "from-bare");
    line.method("pvt", METHODS[2].1, "bare/tif", "from-bare");
    let arrays = |run: &str| {
        let mut files = line.bytes(run);
        files.retain(|name, _| name.ends_with(".npy"));
        files
    };
    let (mut whole, bare) = (arrays("run"), arrays("from-bare"));
    whole.retain(|name, _| bare.contains_key(name));
    // Three of the surface, four of the path, one of the dwell, four each of motion and removal.
    assert_eq!(bare.len(), 16, "{:?}", bare.keys());
    assert_eq!(differences(&whole, &bare), Vec::<String>::new());
}

#[test]
fn another_input_is_refused_without_force_and_the_old_artifact_stays() {
    let line = Line::new(2);
    line.expect(0, "fixture coupon.json --out fixture");
    let prepare = "surface prepare --surface fixture/surface --out surface";
    line.expect(0, prepare);
    let before = line.bytes("surface");
    line.expect(2, &format!("{prepare} --level plane"));
    assert_eq!(differences(&before, &line.bytes("surface")), Vec::<String>::new());
    line.expect(0, &format!("{prepare} --level plane --force"));
    let changed = differences(&before, &line.bytes("surface"));
    assert_eq!(changed, ["height_nm.npy", "manifest.json"]);
}

#[test]
fn an_infeasible_dwell_time_is_stretched_or_refused() {
    let line = Line::new(2);
    // 60 mm in 0.1 s: the machine needs 0.24 s for the mean velocity alone.
    fs::create_dir_all(line.path("path")).unwrap();
    fs::create_dir_all(line.path("dwell")).unwrap();
    let save = |file: &str, array: ArrayD<f64>| {
        fs::write(line.path(file), ArrayData::F64(array.into()).to_npy()).unwrap();
    };
    let points = array![[0.0, 0.0], [1.0, 0.0], [61.0, 0.0], [62.0, 0.0]];
    save("path/point_mm.npy", points.into_dyn());
    save("path/dwell_point_mm.npy", array![[0.5, 0.0], [31.0, 0.0], [61.5, 0.0]].into_dyn());
    save("dwell/dwell_s.npy", array![0.1, 0.1, 0.1].into_dyn());

    for mode in ["smooth", "monotone"] {
        let out = format!("trajectory-{mode}");
        let schedule = format!(
            "schedule pvt --mode {mode} --tool-path path --dwell dwell --machine machine.json \
             --out {out}"
        );
        let refused = line.run(&format!("{schedule} --no-stretch"));
        let message = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert_eq!(refused.status.code(), Some(2), "{message}");
        assert!(message.contains("segment 1 (60.0") && message.contains("stretch"), "{message}");
        assert!(!line.path(&out).exists(), "nothing is written");

        line.expect(0, &schedule);
        let manifest = line.json(&format!("{out}/manifest.json"));
        let stretched = manifest["outcome"]["report"]["stretched"].as_array().unwrap();
        let worst = stretched.iter().find(|s| s["segment"] == 1).unwrap();
        assert_eq!(number(&worst["dwell_s"]), 0.1);
        assert!(number(&worst["scheduled_s"]) >= 0.24, "{worst}");
        let verify = "verify --machine machine.json";
        line.expect(0, &format!("{verify} --trajectory {out} --out verdict-{mode}"));
    }
}

#[test]
fn the_closed_loop_gains_and_its_trade_off_is_ordered() {
    let line = Line::new(2);
    line.expect(0, "fixture coupon.json --out run/fixture");
    line.plan("run/fixture/surface", "run/fixture/tif", "run");
    let inputs = "--surface run/surface --tif run/fixture/tif --tool-path run/tool_path \
                  --machine machine.json";
    let said = line.expect(
        0,
        &format!("refine {inputs} --dwell run/dwell --min-dwell-s 0.1 --out run/refined"),
    );
    let rounds = line.json("run/refined/iterations/manifest.json");
    let best_round = rounds["outcome"]["best_round"].as_u64().unwrap();
    assert!(best_round > 0, "the coupon can be refined: {said}");
    // What the loop says of its best round is what simulator and judge say outside of it.
    for command in [
        "simulate --trajectory run/refined/trajectory --tif run/fixture/tif --surface run/surface \
         --out run/refined/removal",
        "verify --trajectory run/refined/trajectory --machine machine.json --out run/refined/verdict",
    ] {
        line.expect(0, command);
    }
    let outside = line.json("run/refined/removal/manifest.json");
    let [inside, outside] = [&rounds, &outside].map(|m| number(&m["outcome"]["rms_nm"]));
    // The same removal: rounding, and the last bit of a number in JSON.
    assert!((inside - outside).abs() < 1e-12, "{inside} {outside}");

    let said = line.expect(
        0,
        &format!("refine pareto {inputs} --min-dwell-s-per-mm 0.02 --prices 3 --out run/pareto"),
    );
    // | method | price | total time | RMS | limits |: dearer seconds give shorter plans, in the end with a
    // larger residual; none is shorter than the volume takes, 64 s.
    let rows = |method: &str| -> Vec<Vec<f64>> {
        said.lines()
            .filter(|l| l.starts_with(&format!("| {method} |")) && l.ends_with("kept |"))
            .map(|l| l.split('|').filter_map(|c| c.trim().parse().ok()).collect())
            .collect()
    };
    let [closed_loop, feed] = ["closed loop", "joint"].map(rows);
    println!("{closed_loop:?} {feed:?}");
    for rows in [&closed_loop, &feed] {
        assert_eq!(rows.len(), 4, "{said}");
        assert!(rows.windows(2).all(|w| w[1][1] <= w[0][1]), "{said}");
        // Regression bound: measured 0.42 of the time at the highest price on the coupon.
        assert!(rows[3][1] < 0.7 * rows[0][1] && rows[3][2] > rows[0][2], "{said}");
        assert!(rows[3][1] > 64.0, "{said}");
    }
    assert!(said.contains("volume / VRR: 64.0 s"), "{said}");
    // The objective that both minimise, from the printed numbers. Motion and times as one problem is never
    // above the closed loop by more than the rounding of these numbers, and the gap at which it ends, 1e-3.
    for (a, b) in closed_loop.iter().zip(&feed) {
        let merit = |row: &Vec<f64>| 0.5 * row[2] * row[2] + row[0] * row[1];
        assert_eq!(a[0], b[0], "{said}");
        assert!(merit(b) <= merit(a) * 1.002 + 1e-4 * a[2], "{said}");
    }
    assert!(line.path("run/pareto/pareto.svg").exists());
    // With other prices it takes the place of what is there.
    line.expect(
        0,
        &format!(
            "refine pareto {inputs} --min-dwell-s-per-mm 0.02 --prices 1 --force --out run/pareto"
        ),
    );
}

/// RMS of the residual of the motion `run` against `surface`.
fn missed(line: &Line, run: &str, surface: &str) -> f64 {
    let out = format!("{run}-against-{surface}").replace('/', "-");
    let simulate = format!("simulate --trajectory {run} --tif run/fixture/tif --surface {surface}");
    line.expect(0, &format!("{simulate} --out {out}"));
    number(&line.json(&format!("{out}/manifest.json"))["outcome"]["rms_nm"])
}

/// Plans, schedules and refines the fixture `name` in `line`; the commands write `run/pvt` and
/// `run/refined`. Returns the inputs of `refine` and what it said.
fn refined(line: &Line, name: &str, floor: &str, flags: &str) -> [String; 2] {
    let recipe = workspace().join("fixtures").join(format!("{name}.json"));
    fs::copy(recipe, line.path("recipe.json")).unwrap();
    line.expect(0, "fixture recipe.json --out run/fixture");
    let plan = "--surface run/fixture/surface --tif run/fixture/tif";
    for command in [
        format!("toolpath raster {plan} --pitch-mm 1 --step-mm 1 --out run/tool_path"),
        format!(
            "dwell bounded-least-squares {plan} --tool-path run/tool_path {floor} --out run/dwell"
        ),
        "schedule pvt --mode monotone --tool-path run/tool_path --dwell run/dwell \
         --machine machine.json --out run/pvt"
            .into(),
    ] {
        line.expect(0, &command);
    }
    let inputs = format!("{plan} --tool-path run/tool_path --machine machine.json {floor}");
    let said =
        line.expect(0, &format!("refine {inputs} --dwell run/dwell {flags} --out run/refined"));
    line.expect(
        0,
        "verify --trajectory run/refined/trajectory --machine machine.json --out run/verdict",
    );
    [inputs, said]
}

#[test]
fn with_noise_the_loop_gains_on_the_true_surface() {
    for (floor, flags) in [
        ("--min-dwell-s 0.1", ""),
        ("--min-dwell-s 0.1", "--noise-rms-nm 0.5"),
        ("--min-dwell-s-per-mm 0.02", ""),
    ] {
        let line = Line::new(2);
        refined(&line, "coupon-noise", floor, flags);
        let recipe = fs::read_to_string(line.path("recipe.json")).unwrap();
        let mut recipe: Value = serde_json::from_str(&recipe).unwrap();
        recipe["noise_rms_nm"] = 0.into();
        fs::write(line.path("true.json"), recipe.to_string()).unwrap();
        line.expect(0, "fixture true.json --out true");
        let [before, after] = ["run/pvt", "run/refined/trajectory"].map(|motion| {
            let measured = missed(&line, motion, "run/fixture/surface");
            (measured, missed(&line, motion, "true/surface"))
        });
        println!("{floor} {flags}: measured, true {before:?} before, {after:?} after");
        assert!(after.0 < before.0, "{before:?} {after:?}");
        // The noise is not in the true surface: what is gained there is no fit of it.
        assert!(after.1 < before.1, "{before:?} {after:?}");
        assert!(after.1 < after.0, "the noise of 0.5 nm is in the measured residual: {after:?}");
    }
}

#[test]
fn a_ring_shaped_tool_is_refined() {
    let line = Line::new(2);
    refined(&line, "coupon-ring", "--min-dwell-s 0.1", "--max-rounds 12");
    let [before, after] =
        ["run/pvt", "run/refined/trajectory"].map(|m| missed(&line, m, "run/fixture/surface"));
    println!("{before} nm before, {after} nm after");
    // Regression bound: measured 0.65 of it on this ring.
    assert!(after < 0.8 * before, "{before} {after}");
}

#[test]
fn where_nothing_can_be_gained_the_loop_says_so() {
    // With noise of 3 nm in the map, a plan that leaves less is as good as any.
    let line = Line::new(2);
    let [_, said] = refined(&line, "coupon", "--min-dwell-s 0.1", "--noise-rms-nm 3");
    let outcome = &line.json("run/refined/iterations/manifest.json")["outcome"];
    assert_eq!((&outcome["end"], &outcome["best_round"]), (&"no-improvement".into(), &0.into()));
    assert!(said.contains("no-improvement after") && said.contains("at a bound"), "{said}");
    let [before, after] =
        ["run/pvt", "run/refined/trajectory"].map(|m| missed(&line, m, "run/fixture/surface"));
    // The same plan, judged twice: rounding.
    assert!(before < 3.0 && (after - before).abs() < 1e-12, "{before} {after}");
}
