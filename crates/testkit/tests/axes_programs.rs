//! Programs of all axes: a plan for the coupon becomes the motion of a five-axis machine and of a spindle machine, goes
//! to every controller, and is read back by `planish-import`, which shares no code with the writer. `planish-verify`
//! judges what was read, and the executed contact point predicts the residual.

use planish_axes::{MotionSettings, contact, motion};
use planish_dwell::bounded_least_squares;
use planish_export::{
    About, Origin, PATH_DEVIATION_MM, ProgramSettings, gcode, pmac, program, program_of_axes,
};
use planish_fixture::{Fixture, Recipe, make};
use planish_form::{Form, FormFile};
use planish_import::program::{self as reader, Configuration};
use planish_schedule::pvt::{self, Mode};
use planish_simulate::simulate;
use planish_testkit::workspace;
use planish_toolpath::{RasterSettings, SpiralSettings, raster, spiral};
use planish_types::{
    AxesMotion, ControllerKind, Counts, Interpolation, Machine, MachineFile, Surface, Tif,
    Trajectory,
};
use planish_verify::{Program, VerifySettings, verify_axes};
use serde_json::{Value, json};

fn fixture() -> Fixture {
    let text = std::fs::read_to_string(workspace().join("fixtures/coupon.json")).unwrap();
    make(&serde_json::from_str::<Recipe>(&text).unwrap()).unwrap()
}

fn machine(name: &str, change: impl FnOnce(&mut Value)) -> Machine {
    let path = workspace().join(format!("fixtures/machines/{name}.json"));
    let mut file: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    change(&mut file);
    Machine::new(serde_json::from_value::<MachineFile>(file).unwrap()).unwrap()
}

/// A sphere about the middle of the coupon of 20 x 12 mm, with a slope of 10 degrees at the ends of its x axis:
/// R = 10 mm / sin(10 deg).
fn sphere() -> Form {
    let file = json!({ "kind": "sphere", "radius_mm": -57.6, "vertex_mm": [10, 6] });
    Form::new(&serde_json::from_value::<FormFile>(file).unwrap(), None).unwrap()
}

/// A part with its tool, and the motion of the axes of a machine over it.
struct Plan {
    surface: Surface,
    tif: Tif,
    form: Form,
    machine: Machine,
    motion: AxesMotion,
}

impl Plan {
    /// A raster on the five-axis machine, or a spiral on the spindle machine with the coupon in its centre.
    fn new(is_spindle: bool) -> Self {
        let Fixture { surface, tif, .. } = fixture();
        let path = match is_spindle {
            false => raster(&surface, &RasterSettings::new(0.8, 0.8, 3.0)).unwrap(),
            true => {
                let settings = SpiralSettings { pitch_mm: 0.8, step_mm: 0.8, overscan_mm: 3.0 };
                spiral(&surface, &settings).unwrap()
            }
        };
        let settings = bounded_least_squares::BoundedSettings::default();
        let dwell =
            bounded_least_squares::solve(&surface, &tif, &path, None, &settings).unwrap().dwell;
        let machine = match is_spindle {
            false => machine("bonnet-five-axis", |_| {}),
            true => machine("spindle", |file| file["part_origin_mm"] = json!([-10, -6])),
        };
        let settings = pvt::PvtSettings::new(Mode::Smooth);
        let plan = pvt::schedule(&path, &dwell, machine.limits(), &settings).unwrap().trajectory;
        let form = sphere();
        let motion = motion(&plan, &machine, &form, &MotionSettings::default()).unwrap().0;
        Self { surface, tif, form, machine, motion }
    }

    /// Residual RMS of a motion of the axes, nm.
    fn residual_nm(&self, motion: &AxesMotion) -> f64 {
        let executed = contact(motion, &self.machine, &self.form).unwrap().0;
        let gridded = planish_simulate::SimulationSettings::Gridded;
        let removal = simulate(&executed, &self.tif, &self.surface, gridded).unwrap().removal;
        let left = removal.residual().height_nm().iter().copied().filter(|v| v.is_finite());
        let (n, sum, squares) =
            left.fold((0.0, 0.0, 0.0), |(n, s, q), v| (n + 1.0, s + v, q + v * v));
        (squares / n - (sum / n) * (sum / n)).sqrt()
    }

    fn program(&self, controller: ControllerKind, settings: &ProgramSettings) -> (String, About) {
        let origin = Origin { made_from: "a test".into(), ..Origin::default() };
        let (motion, machine) = (&self.motion, &self.machine);
        let made = program_of_axes(motion, machine, &self.form, controller, settings, &origin)
            .unwrap_or_else(|e| panic!("{controller:?}: {e}"));
        (made.text, made.about)
    }
}

/// Settings of G-code for a planner that was tried with rotary axes.
fn tried() -> gcode::GcodeSettings {
    gcode::GcodeSettings { rotary_lines: true, ..gcode::GcodeSettings::default() }
}

/// The motion that a program makes, read with the file beside it, as a user reads it.
fn read_back(controller: ControllerKind, text: &str, about: &About) -> AxesMotion {
    let about = serde_json::to_string(about).unwrap();
    let configuration: Configuration = serde_json::from_str(&about).unwrap();
    reader::read_axes(controller, text.as_bytes(), &configuration)
        .unwrap_or_else(|e| panic!("{controller:?}: {e}"))
}

#[test]
fn programs_of_five_axes_and_of_a_spindle_keep_the_limits_and_the_residual() {
    for is_spindle in [false, true] {
        let plan = Plan::new(is_spindle);
        let planned_nm = plan.residual_nm(&plan.motion);
        let pmac = pmac::PmacSettings { tool_output: Some(1), ..Default::default() };
        let settings = ProgramSettings { pmac, gcode: tried(), ..ProgramSettings::default() };
        for controller in ControllerKind::ALL {
            let name = format!("{}, {controller:?}", plan.machine.name());
            let (text, about) = plan.program(controller, &settings);
            let run = read_back(controller, &text, &about);
            let program = match controller.model().interpolation {
                Interpolation::Linear => Program::Lines,
                Interpolation::Hermite => Program::Cubics,
            };
            let settings = VerifySettings { program: Some(program), ..VerifySettings::default() };
            let verdict = verify_axes(&run, &plan.machine, &settings).unwrap();
            assert!(verdict.limits_respected, "{name}: {:?}", verdict.reason());
            // The contact point stays nearer than the axes with their levers may: the map adds no way of its own.
            let contact_mm = about.contact_deviation_mm.unwrap();
            assert!(about.path_deviation_mm <= PATH_DEVIATION_MM, "{name}: {about:?}");
            assert!(contact_mm <= PATH_DEVIATION_MM, "{name}: {contact_mm} mm");
            // 2 % is the row of the requirement.
            let ratio = plan.residual_nm(&run) / planned_nm;
            assert!((0.98..=1.02).contains(&ratio), "{name}: {ratio} of {planned_nm} nm");
            // Joined lines begin and end half a line earlier and later.
            let longer_s = run.total_time_s() - about.total_time_s;
            assert!((-1e-9..0.02).contains(&longer_s), "{name}: {longer_s} s");
        }
    }
}

#[test]
fn a_program_says_its_axes_and_their_units() {
    let plan = Plan::new(true);
    let (text, about) = plan.program(ControllerKind::Csv, &ProgramSettings::default());
    let columns =
        "t_s,r_mm,vr_mm_per_s,z_mm,vz_mm_per_s,c_deg,vc_deg_per_s,b_deg,vb_deg_per_s,tool_on";
    assert!(text.contains(columns), "{text:.2000}");
    assert!(text.contains(
        "# kinematics: spindle, pivot 80 mm from the contact point, axes r in mm, z in mm"
    ));
    assert!(text.contains("counts on beyond a turn: the controller must not roll it over"));
    assert!(text.contains("its origin where the axes read x -10 mm, y -6 mm"), "{text:.2000}");
    assert_eq!(about.start_mm, None);
    let axes: Vec<(&str, &str)> = about.axes.iter().map(|a| (a.name, a.unit)).collect();
    assert_eq!(axes, [("r", "mm"), ("z", "mm"), ("c", "deg"), ("b", "deg")]);
    // Every line of G-code has the four words, and a radius is X.
    let settings = ProgramSettings { gcode: tried(), ..ProgramSettings::default() };
    let (text, _) = plan.program(ControllerKind::Gcode, &settings);
    let lines: Vec<&str> = text.lines().filter(|l| l.starts_with("G53 G1 ")).collect();
    let has = |line: &str| [" X", " Z", " C", " B", " F"].iter().all(|word| line.contains(word));
    assert!(lines.len() > 100 && lines.iter().all(|line| has(line)));
    let (text, _) = plan.program(ControllerKind::Galil, &ProgramSettings::default());
    // The header has lines of 80 characters.
    let header = text.replace("\n' ... ", " ");
    assert!(header.contains("C = c in counts of 0.0001 deg") && text.contains("\nBTABCD\n"));
}

#[test]
fn what_no_program_of_all_axes_can_do_is_refused() {
    let plan = Plan::new(false);
    let origin = Origin::default();
    let refused = |controller: ControllerKind, settings: &ProgramSettings| {
        let (motion, machine) = (&plan.motion, &plan.machine);
        let made = program_of_axes(motion, machine, &plan.form, controller, settings, &origin);
        made.unwrap_err().to_string()
    };
    // Unless the planner was tried, and with every kind that the message names.
    let said = refused(ControllerKind::Gcode, &ProgramSettings::default());
    assert!(said.contains("give `rotary_lines`"), "{said}");
    for kind in [ControllerKind::Csv, ControllerKind::SinumerikPoly] {
        assert!(said.contains(kind.name()), "{said}");
        plan.program(kind, &ProgramSettings::default());
    }
    let gcode = gcode::GcodeSettings { feed: gcode::Feed::PerMinute, ..tried() };
    let said =
        refused(ControllerKind::Gcode, &ProgramSettings { gcode, ..ProgramSettings::default() });
    assert!(said.contains("f_word: is per-minute") && said.contains("give inverse-time"), "{said}");
    // A count of 0.01 degrees is 14 um at the pivot of 80 mm.
    let coarse = Counts { mm: None, deg: Some(vec![0.01]) };
    let said = refused(
        ControllerKind::Csv,
        &ProgramSettings { counts: coarse, ..ProgramSettings::default() },
    );
    assert!(said.contains("count_deg: is 0.01 (0.013963 mm at the lever of the axis)"), "{said}");
    let three = Counts { mm: None, deg: Some(vec![1e-4; 3]) };
    let said = refused(
        ControllerKind::Csv,
        &ProgramSettings { counts: three, ..ProgramSettings::default() },
    );
    assert!(
        said.contains("count_deg: has 3 numbers; give one for each of the axes a, b"),
        "{said}"
    );
    // The motion of another machine.
    let spindle = machine("spindle", |_| {});
    let settings = ProgramSettings::default();
    let made = program_of_axes(
        &plan.motion,
        &spindle,
        &plan.form,
        ControllerKind::Csv,
        &settings,
        &origin,
    );
    let said = made.unwrap_err().to_string();
    assert!(said.contains("has 5 axes, and the machine has 4"), "{said}");
    // A machine with less acceleration than the motion uses.
    let weak = machine("bonnet-five-axis", |file| {
        file["rotary_axes"][1]["max_acceleration_deg_per_s2"] = json!(1);
    });
    let made =
        program_of_axes(&plan.motion, &weak, &plan.form, ControllerKind::Csv, &settings, &origin);
    let said = made.unwrap_err().to_string();
    assert!(said.contains("deg/s") && said.contains("planish axes motion"), "{said}");
    // A trajectory of x and y does not move this machine.
    let rest = [[0.0; 4]; 2];
    let stands = Trajectory::new(vec![0.0, 1.0], vec![rest], vec![true], vec![None]).unwrap();
    let made = program(&stands, &plan.machine, ControllerKind::Csv, &settings, &origin);
    assert!(made.unwrap_err().to_string().contains("other axes than x and y"));
}
