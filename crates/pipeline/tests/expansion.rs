//! Tests of the commands that the definition of every pipeline gives.

use planish_pipeline::{
    definition::Definition,
    scope::Scope,
    walk::{StageCommand, Walk},
};

/// Returns the commands of a stage with these settings, for a user in the repository and a machine with these
/// kinematics.
fn commands(pipeline: &str, stage: &str, settings: &[&str], kinematics: &str) -> Vec<StageCommand> {
    let definition = Definition::built_in(pipeline).unwrap();
    let mut scope = Scope::new(&definition, settings).unwrap();
    scope.check().unwrap();
    for (fact, words) in [
        ("repository", vec![]),
        ("surface_name", vec!["mirror"]),
        ("directory_name", vec!["m"]),
        ("machine_name", vec!["machine.json"]),
        ("machine_title", vec!["ion-beam"]),
        ("surface_kind", vec![if scope.is_given("surface") { "bare" } else { "none" }]),
        ("tif_kind", vec![if scope.is_given("tif") { "file" } else { "none" }]),
        ("kinematics", vec![kinematics]),
        ("fixture_tool", vec![]),
    ] {
        scope.set(fact, words.into_iter().map(String::from).collect());
    }
    Walk::commands(scope, stage).unwrap()
}

/// Returns the names of the programs without `planish-`, each with the artifact that it writes, without the directory
/// of the run.
fn outline(commands: &[StageCommand]) -> String {
    let word = |command: &StageCommand| {
        let program = command.program.trim_start_matches("planish-").to_string();
        let out = command.arguments.iter().skip_while(|a| *a != "--out").nth(1);
        let out = out.map(|out| out.splitn(4, '/').nth(3).unwrap_or(out).to_string());
        out.map_or(program.clone(), |out| format!("{program}:{out}"))
    };
    commands.iter().map(word).collect::<Vec<_>>().join(" ")
}

/// Returns the outline of a plan that was made by `program`, simulated and judged.
fn judged(program: &str, method: &str) -> String {
    let trajectory = if program == "schedule" { "/trajectory" } else { "" };
    format!(
        "{program}:methods/{method}{trajectory} simulate:methods/{method}/removal verify:methods/{method}/verdict"
    )
}

#[test]
fn every_pipeline_expands_to_its_commands() {
    let mirror = "fixture:fixture surface:surface";
    let three =
        ["position", "constant-acceleration", "pvt"].map(|m| judged("schedule", m)).join(" ");
    let refined = judged("refine", "pvt+refined");
    let joint = judged("joint", "joint");
    let films = |methods: &[&str]| {
        methods.iter().map(|m| format!(" simulate:methods/{m}/frames")).collect::<String>()
    };
    let end = "compare:report run";
    let whole = format!(
        "{mirror} toolpath:tool_path dwell:dwell {three} {refined} {joint}{} {end}",
        films(&["pvt", "pvt+refined", "joint"])
    );
    let without_joint = format!(
        "{mirror} toolpath:tool_path dwell:dwell {three} {refined}{} {end}",
        films(&["pvt", "pvt+refined"])
    );
    for pipeline in ["raster", "maze", "spiral", "random-adaptive"] {
        assert_eq!(outline(&commands(pipeline, "run", &[], "xy")), whole, "{pipeline}");
    }
    assert_eq!(outline(&commands("multi-pitch", "run", &[], "xy")), without_joint);
    let line = without_joint.replace(mirror, "fixture:fixture surface:line surface:surface");
    assert_eq!(outline(&commands("line", "run", &[], "xy")), line);
    let trig = judged("schedule", "trig-spline");
    let program = "schedule:program.nc schedule:reference.npy";
    let expected =
        format!("{mirror} toolpath:tool_path dwell:dwell {three} {trig} {program} {end}");
    assert_eq!(outline(&commands("trig-spline", "run", &[], "xy")), expected);
    let feeds = ["vrr", "bspline"].map(|m| judged("bspline-feed", m)).join(" ");
    let expected = format!("{mirror} toolpath:tool_path {feeds} {end}");
    assert_eq!(outline(&commands("bspline", "run", &[], "xy")), expected);
    let solvers = commands("compare-dwell", "run", &[], "xy");
    assert_eq!(solvers.len(), 3 + 12 * 5 + 2, "{}", outline(&solvers));
}

#[test]
fn settings_add_and_leave_out_commands() {
    let quick = ["refine=no", "plan_joint=no", "frames=0"];
    let with = |more: &[&str], kinematics: &str| {
        outline(&commands("raster", "run", &[&quick[..], more].concat(), kinematics))
    };
    let plain = with(&[], "xy");
    assert!(
        !plain.contains("refine") && !plain.contains("joint") && !plain.contains("frames"),
        "{plain}"
    );
    for (more, kinematics, found) in [
        (&["passes=3"][..], "xy", "toolpath:one_pass toolpath:tool_path dwell:dwell"),
        (&["surface=s", "tif=t"], "xy", "surface:import/surface tool:import/tif surface:surface"),
        (&["varying=edge --pad-radius-mm 3"], "xy", "tool:tool toolpath:tool_path"),
        (&["error_budget=e.json"], "xy", "simulate:methods/pvt/removal-after-servo"),
        (&["error_budget=e.json"], "xy", "tolerance:tolerance"),
        (&["specification=s.json"], "xy", "surface:specified/pvt/specification"),
        (&[], "xyz", "axes:methods/pvt/on-axes/axes verify:methods/pvt/on-axes/verdict"),
        (
            &["export=galil", "program_of=pvt"],
            "xy",
            "export:program.galil import:methods/pvt+galil/trajectory simulate:methods/pvt+galil/removal",
        ),
        (
            &["export=galil"],
            "spindle",
            "compare:report export:program.galil import:program-on-axes/axes",
        ),
    ] {
        let outlined = with(more, kinematics);
        assert!(outlined.contains(found), "{more:?}: {outlined}");
        assert!(!plain.contains(found), "{found}");
    }
}

#[test]
fn a_setting_is_one_argument_whatever_it_holds() {
    let hostile = "$(touch x) 'a' \"b\" --force\n{out} [c] when d";
    let (surface, out) = (format!("surface={hostile}"), format!("out=-{hostile}"));
    let made = commands("raster", "run", &[&surface, "tif=t", &out], "xy");
    let seal = &made[0].arguments;
    assert_eq!(seal[2], hostile);
    assert_eq!(seal[6], format!("./-{hostile}/import/surface"));
}
