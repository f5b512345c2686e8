//! The limits of the machine on the motion that a program asks for.

use planish_export::{
    About, Common, Controller, Origin, csv, galil, gcode, limits::MOST_EXCESS, pmac, program, xps,
};
use planish_types::{Limits, MachineFile, MachineFileAxis, Trajectory};

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

/// From rest to rest over `d` in `t`: v = 1.5 d/t in the middle, a = 6 d/t^2 at the ends, j = 12 d/t^3.
fn rest_to_rest(d: f64, t: f64) -> Trajectory {
    let c = [[0.0, 0.0, 3.0 * d / (t * t), -2.0 * d / (t * t * t)], [0.0; 4]];
    Trajectory::new(vec![0.0, t], vec![c], vec![true], vec![Some(0)]).unwrap()
}

fn controllers() -> [Controller; 5] {
    [
        Controller::Galil(galil::Settings::default()),
        Controller::Xps(xps::Settings::default()),
        Controller::Pmac(pmac::Settings::default()),
        Controller::Gcode(gcode::Settings::default()),
        Controller::Csv(csv::Settings::default()),
    ]
}

fn export(
    plan: &Trajectory,
    machine: &Limits,
    controller: &Controller,
    count: f64,
) -> Result<About, String> {
    let common = Common { count_mm: [count; 2], max_step_s: None, always_on: false };
    let origin = Origin { made_from: "a test".into(), made_by: "hand".into(), ..Origin::default() };
    let made = program(plan, &machine.clone().into(), controller, &common, &origin)
        .map_err(|e| e.to_string())?;
    assert_eq!(made.about.program_blake3, blake3::hash(made.text.as_bytes()).to_hex().as_str());
    Ok(made.about)
}

/// Only the ends were looked at: there the velocity is zero.
#[test]
fn a_limit_within_a_segment_is_found_for_every_controller() {
    // v = 15, a = 60 mm/s^2, j = 120 mm/s^3 (and a step of the acceleration at both ends).
    let plan = rest_to_rest(10.0, 1.0);
    for controller in controllers() {
        let refused = |v, a, j| export(&plan, &machine(v, a, j), &controller, 1e-4).unwrap_err();
        assert!(
            export(&plan, &machine(15.0, 60.0, None), &controller, 1e-4).is_ok(),
            "{controller:?}"
        );
        let said = refused(14.9, 60.0, None);
        assert!(
            said.contains("segment[0]: x velocity reaches 15.000000 mm/s after 0.500000 s, the limit is 14.9 mm/s")
                && said.contains("planish-schedule pvt"),
            "{said}"
        );
        let said = refused(15.0, 59.9, None);
        assert!(said.contains("x acceleration reaches 60.000000 mm/s^2"), "{said}");
        let said = refused(15.0, 60.0, Some(1e6));
        assert!(said.contains("step of 60.000000 mm/s^2 in the acceleration of x"), "{said}");
    }
}

/// A plan at its limits, and rounding that makes it faster: a count of 0.01 mm adds up to 0.005 mm to 1 mm.
#[test]
fn what_rounding_adds_is_stated_and_more_is_refused() {
    let plan = rest_to_rest(1.0049, 0.125);
    // v = 12.0588, a = 385.88
    let machine = machine(12.06, 385.9, None);
    for controller in controllers() {
        let about = export(&plan, &machine, &controller, 1e-4).unwrap();
        assert!(about.limits.largest.iter().all(|p| p.excess == 0.0), "{controller:?}: {about:?}");
        // From rest to rest f = 3 u^2 - 2 u^3 of 1.0049 mm: at a quarter 10 / 64 and not 16 / 64.
        let expected = 1.0049 * 6.0 / 64.0;
        match about.from_straight_mm {
            None => assert!(about.warnings.is_empty(), "{:?}", about.warnings),
            Some(mm) => {
                assert!((mm - expected).abs() < 1e-12 && about.warnings.len() == 1, "{about:?}");
                assert!(about.warnings[0].contains("0.094 mm from where the plan is"));
            }
        }
        assert_eq!(about.from_straight_mm.is_some(), about.controller == "gcode");
    }
    // 1.01 mm instead of 1.0049: 0.5 percent more.
    let shorter = rest_to_rest(1.0051, 0.125);
    let machine = self::machine(12.0612, 385.959, None);
    let pmac = Controller::Pmac(pmac::Settings::default());
    let about = export(&shorter, &machine, &pmac, 1e-2).unwrap();
    let peak = about.limits.largest.iter().find(|p| p.quantity == "x acceleration").unwrap();
    // 1.01 / 1.0051 - 1
    assert!((peak.excess - 0.004875).abs() < 1e-5, "{peak:?}");
    assert!(
        (peak.value - 6.0 * 1.01 / 0.125f64.powi(2)).abs() < 1e-9 && peak.segment == 0,
        "{peak:?}"
    );
    let warned = about.warnings.iter().any(|w| w.contains("x acceleration of 387.84"));
    assert!(warned, "{:?}", about.warnings);
    // 0.13 s are three ticks of 0.04 s: 17 percent more acceleration.
    let coarse = Controller::Csv(csv::Settings { tick_s: 0.04 });
    let machine = self::machine(1e3, 6.0 / 0.13f64.powi(2) * 1.001, None);
    let said = export(&rest_to_rest(1.0, 0.13), &machine, &coarse, 1e-4).unwrap_err();
    assert!(
        said.contains("segment[0]: x acceleration is 416.6666") && said.contains("5 % is the most"),
        "{said}"
    );
    assert!(said.contains("give a smaller count or tick"), "{said}");
    const { assert!(MOST_EXCESS < 0.17) };
    assert!(
        export(&rest_to_rest(1.0, 0.11), &machine, &coarse, 1e-4).unwrap_err().contains("reaches")
    );
}

#[test]
fn the_shortest_segment_holds_after_rounding() {
    let plan = rest_to_rest(0.01, 0.0195);
    let machine = MachineFile { min_segment_s: 0.0195, ..(&machine(1e3, 1e6, None)).into() };
    let machine = machine.checked().unwrap();
    // Ten ticks, 0.01953 s.
    let galil = &controllers()[0];
    assert!(export(&plan, &machine, galil, 1e-4).is_ok());
    let slow = Controller::Galil(galil::Settings { sample_s: 128.0 / 32768.0 });
    // Two ticks of 0.0078 s, 0.0156 s.
    let said = export(&plan, &machine, &slow, 1e-4).unwrap_err();
    assert!(said.contains("segment[0]: shortest duration is 0.015625 s, 19.87 % beyond"), "{said}");
}

/// The executed motion of random plans, judged by sampling the numbers of the table.
#[test]
fn largest_values_are_those_of_the_program() {
    for (d, t) in [(3.0, 0.4), (-7.0, 1.3), (0.02, 0.05), (55.0, 4.0)] {
        let plan = rest_to_rest(d, t);
        let about = export(&plan, &machine(1e4, 1e6, Some(1e12)), &controllers()[3], 1e-4);
        // A limit on jerk refuses the step of the acceleration.
        assert!(about.is_err());
        let about = export(&plan, &machine(1e4, 1e6, None), &controllers()[4], 1e-4).unwrap();
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
