//! Tests that the motion that a program asks for keeps the limits of the machine.

use planish_export::{About, Origin, ProgramSettings, program};
use planish_types::{
    ControllerKind, Counts, Interpolation, Limits, Machine, MachineFile, MachineFileAxis,
    Trajectory,
};

fn machine(v: f64, a: f64, j: Option<f64>) -> Limits {
    let axis = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: v,
        max_acceleration_mm_per_s2: a,
        max_jerk_mm_per_s3: j,
        ..MachineFileAxis::default()
    };
    MachineFile {
        name: "bench".into(),
        axes: vec![axis("x"), axis("y")],
        min_segment_s: 0.0,
        ..MachineFile::default()
    }
    .checked()
    .unwrap()
}

/// Makes a motion from rest to rest over `d`, mm, in `t`, s. Its velocity is 1.5 d/t in the middle, its acceleration 6
/// d/t^2 at the ends, its jerk 12 d/t^3.
fn rest_to_rest(d: f64, t: f64) -> Trajectory {
    let c = [[0.0, 0.0, 3.0 * d / (t * t), -2.0 * d / (t * t * t)], [0.0; 4]];
    Trajectory::new(vec![0.0, t], vec![c], vec![true], vec![Some(0)]).unwrap()
}

fn export(
    plan: &Trajectory,
    machine: &Limits,
    controller: ControllerKind,
    count: f64,
    tick_s: Option<f64>,
) -> Result<About, String> {
    let settings =
        ProgramSettings { counts: Counts::linear(count), tick_s, ..ProgramSettings::default() };
    let origin = Origin { made_from: "a test".into(), made_by: "hand".into(), ..Origin::default() };
    let made = program(plan, &machine.clone().into(), controller, &settings, &origin)
        .map_err(|e| e.to_string())?;
    assert_eq!(made.about.program_blake3, blake3::hash(made.text.as_bytes()).to_hex().as_str());
    Ok(made.about)
}

/// Checks that the velocity limit holds within a segment, for a plan whose velocity is zero at its ends.
#[test]
fn a_limit_within_a_segment_is_found_for_every_controller() {
    // v = 15, a = 60 mm/s^2, j = 120 mm/s^3 (and a step of the acceleration at both ends).
    let plan = rest_to_rest(10.0, 1.0);
    for controller in ControllerKind::ALL {
        let refused =
            |v, a, j| export(&plan, &machine(v, a, j), controller, 1e-4, None).unwrap_err();
        assert!(
            export(&plan, &machine(15.0, 60.0, None), controller, 1e-4, None).is_ok(),
            "{controller:?}"
        );
        let said = refused(14.9, 60.0, None);
        assert!(
            said.contains("segment[0]: x velocity reaches 15.000000 mm/s after 0.500000 s, the limit is 14.9 mm/s")
                && said.contains("planish schedule pvt"),
            "{said}"
        );
        let said = refused(15.0, 59.9, None);
        assert!(said.contains("x acceleration reaches 60.000000 mm/s^2"), "{said}");
        let said = refused(15.0, 60.0, Some(1e6));
        assert!(said.contains("step of 60.000000 mm/s^2 in the acceleration of x"), "{said}");
    }
}

/// Checks the programs of a motion from rest to rest at its limits, 0.125 s long with 385.88 mm/s^2. Whatever the clock
/// and the count, the program keeps the limits and takes at most a few percent longer.
#[test]
fn a_plan_at_its_limits_is_a_program_within_them() {
    let plan = rest_to_rest(1.0049, 0.125);
    // v = 12.0588, a = 385.88
    let machine = machine(12.06, 385.9, None);
    for controller in ControllerKind::ALL {
        for (count, tick_s) in [(1e-4, None), (1e-3, None), (1e-4, Some(4e-3)), (1e-4, Some(5e-4))]
        {
            let mut made = export(&plan, &machine, controller, count, tick_s);
            // A count of 0.1 um is 1 % of the acceleration of lines of 4 ms, one of 1 um 10 %.
            let is_linear = controller.model().interpolation == Interpolation::Linear;
            if let (true, Err(said)) = (is_linear, &made) {
                assert!(said.contains("give `count_mm` 0.000001"), "{said}");
                made = export(&plan, &machine, controller, 1e-6, None);
            }
            let about = made.unwrap();
            let kept = about.limits.largest.iter().all(|p| p.value <= p.limit * (1.0 + 1e-9));
            assert!(kept && about.path_deviation_mm <= 0.005, "{controller:?}: {about:?}");
            // Two margins of 2 percent of the acceleration, counts of 1 um at 0.1 mm, and one tick. Lines begin and end half a
            // line of 7 ms outside.
            let lines_s = if is_linear { 7e-3 } else { 0.0 };
            let most = 0.06 * 0.125 + tick_s.unwrap_or(2e-3) + lines_s;
            assert!(about.added_time_s >= -1e-9 && about.added_time_s <= most, "{about:?}");
        }
    }
    // A tick of 0.04 s has three segments for 0.125 s, which no motion at the limits fits.
    let coarse = export(&plan, &machine, ControllerKind::Csv, 1e-4, Some(0.04)).unwrap();
    assert!(coarse.added_time_s > 0.03 * 0.125 && coarse.warnings.len() == 1, "{coarse:?}");
    assert!(coarse.warnings[0].contains("% longer than the plan"), "{:?}", coarse.warnings);
    // Half the deviation is the least that a count may be.
    let said = export(&plan, &machine, ControllerKind::Csv, 4e-3, None).unwrap_err();
    assert!(said.contains("count_mm: is 0.004, more than half the path deviation"), "{said}");
    assert!(said.contains("larger `path_deviation_mm`"), "{said}");
}

#[test]
fn no_segment_is_shorter_than_the_machine_takes() {
    let plan = rest_to_rest(0.01, 0.0195);
    let machine = MachineFile { min_segment_s: 0.0195, ..(&machine(1e3, 1e6, None)).into() };
    let machine = machine.checked().unwrap();
    // Ten ticks, 0.01953 s.
    let about = export(&plan, &machine, ControllerKind::Galil, 1e-4, None).unwrap();
    assert_eq!((about.segments, about.total_time_s), (1, 20.0 / 1024.0));
    // Two ticks of 0.0078 s are shorter: three.
    let about =
        export(&plan, &machine, ControllerKind::Galil, 1e-4, Some(256.0 / 32768.0)).unwrap();
    assert_eq!((about.segments, about.total_time_s), (1, 3.0 * 256.0 / 32768.0));
}

/// Checks a motion that turns between two nodes, at the end of the travel, 2.5 mm beyond the ends of its segments. The
/// head of the program states that reach, and the program goes no further, whatever its clock.
#[test]
fn the_travel_holds_between_the_nodes_too() {
    let hermite = |p: [f64; 2], v: [f64; 2], h: f64| {
        let mean = (p[1] - p[0]) / h;
        [p[0], v[0], (3.0 * mean - 2.0 * v[0] - v[1]) / h, (v[0] + v[1] - 2.0 * mean) / (h * h)]
    };
    for turn_s in [0.1, 0.1006, 0.1013] {
        let segments = [
            hermite([-5.0, 0.0], [0.0, 100.0], 0.1),
            hermite([0.0, 0.0], [100.0, -100.0], turn_s),
            hermite([0.0, -5.0], [-100.0, 0.0], 0.1),
        ];
        let times = vec![0.0, 0.1, 0.1 + turn_s, 0.2 + turn_s];
        let coefficients = segments.map(|x| [x, [0.0; 4]]).to_vec();
        let plan = Trajectory::new(times, coefficients, vec![true; 3], vec![None; 3]).unwrap();
        let top = 100.0 * turn_s / 4.0;
        let mut file: MachineFile = (&machine(250.0, 2000.0, None)).into();
        file.axes[0].travel_mm = Some([-5.0, top]);
        let machine = Machine::new(file).unwrap();
        let origin =
            Origin { made_from: "a test".into(), made_by: "hand".into(), ..Origin::default() };
        for controller in ControllerKind::ALL {
            // With counts of 1 nm, cubics come to the end of the travel in more rounds than are tried.
            let counts = match controller.model().interpolation {
                Interpolation::Hermite => Counts::linear(1e-4),
                Interpolation::Linear => Counts::default(),
            };
            let settings = ProgramSettings { counts, ..ProgramSettings::default() };
            let made = program(&plan, &machine, controller, &settings, &origin).unwrap();
            let [low, high] = made.about.limits.reach_mm[0];
            assert!(low >= -5.0 - 1e-9 && high <= top + 1e-9, "{controller:?}: {low} to {high}");
            // Within the path deviation of where the plan turns, not of the ends of its segments.
            assert!(high > top - 0.005, "{controller:?}: {high} of {top}");
            let head = made.about.preamble.iter().find(|l| l.starts_with("reach: x from "));
            let words: Vec<&str> = head.unwrap().split_whitespace().collect();
            let said: f64 = words[5].parse().unwrap();
            assert!((said - high).abs() <= 0.5e-4 + 1e-12, "{words:?}: {high}");
        }
    }
}

/// Checks the executed motion of random plans, by samples of the motion that the numbers of the table define.
#[test]
fn largest_values_are_those_of_the_program() {
    for (d, t) in [(3.0, 0.4), (-7.0, 1.3), (0.02, 0.05), (55.0, 4.0)] {
        let plan = rest_to_rest(d, t);
        let about =
            export(&plan, &machine(1e4, 1e6, Some(1e12)), ControllerKind::Gcode, 1e-4, None);
        // A limit on jerk refuses the step of the acceleration.
        assert!(about.is_err());
        let about =
            export(&plan, &machine(1e4, 1e6, None), ControllerKind::Csv, 1e-4, None).unwrap();
        let value = |name: &str| {
            about.limits.largest.iter().find(|p| p.quantity == name).map(|p| p.value).unwrap()
        };
        // Times in us, positions in 0.1 um: 1e-4 mm / d relative.
        let close =
            |found: f64, expected: f64| (found / expected - 1.0).abs() < 1e-4 / d.abs() + 1e-4;
        assert!(close(value("x velocity"), 1.5 * d.abs() / t), "{about:?}");
        assert!(close(value("x acceleration"), 6.0 * d.abs() / (t * t)), "{about:?}");
        assert_eq!(value("y velocity"), 0.0);
    }
}
