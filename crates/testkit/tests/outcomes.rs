//! What stages write, and what others read of it (`types::outcome`).

use planish_compare::plan::{PlanStatus, State};
use planish_simulate::virtual_machine;
use planish_tolerance::Free;
use planish_toolpath::{RasterSettings, SpiralSettings};
use planish_types::{
    End, MachineFile, MachineFileAxis, Trajectory,
    outcome::{
        StageEnd, StageStatus,
        plan::{PlanOutcome, ProvenGap, StatedEnd},
        removal::{RemovalOutcome, ServoOutcome},
        settings::PathSettings,
        specification::SpecificationOutcome,
        tolerance::ToleranceSettings,
        verdict::Verdict,
        virtual_machine::RunSettings,
    },
};
use planish_verify::{VerifySettings, verify};
use serde_json::{from_value, json};

#[test]
fn a_verdict_reads_as_it_was_written() {
    let axis = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: 1.0,
        max_acceleration_mm_per_s2: 1.0,
        ..MachineFileAxis::default()
    };
    let machine = MachineFile { axes: vec![axis("x"), axis("y")], ..MachineFile::default() };
    let limits = machine.checked().unwrap();
    // x = 2 u + 3 u^2 for 1 s: too fast, and it starts and ends with a step of the velocity.
    let cubics = vec![[[0.0, 2.0, 3.0, 0.0], [0.0; 4]]];
    let motion = Trajectory::new(vec![0.0, 1.0], cubics, vec![true], vec![None]).unwrap();
    let written = json!(verify(&motion, &limits, &VerifySettings::default()).unwrap());
    assert_eq!(written["limits_respected"], false);
    assert_eq!(written["axes"][0]["velocity_mm_per_s"]["worst"][0]["dwell_index"], -1);
    let read: Verdict = serde_json::from_str(&written.to_string()).unwrap();
    assert_eq!(json!(read), written);
}

#[test]
fn settings_are_read_as_stages_write_them() {
    for (free, word) in [(Free::Piston, "piston"), (Free::Plane, "plane")] {
        let written = json!(planish_tolerance::ToleranceSettings { free, ..Default::default() });
        let read: ToleranceSettings = from_value(written).unwrap();
        assert_eq!(read.free.as_deref(), Some(word));
    }
    let written = virtual_machine::VirtualMachineSettings {
        seed: 7,
        run: 2,
        known: true,
        tif_as_sampled: false,
    };
    let read: RunSettings = from_value(json!(written)).unwrap();
    assert_eq!(read, RunSettings { seed: 7, run: 2, known: true });
    let spiral = SpiralSettings { pitch_mm: 1.0, step_mm: 0.5, overscan_mm: 2.5 };
    for written in [json!(RasterSettings::new(1.0, 0.5, 2.5)), json!(spiral)] {
        let read: PathSettings = from_value(written).unwrap();
        assert_eq!(read.overscan_mm, Some(2.5));
    }
}

#[test]
fn an_outcome_of_a_foreign_program_may_lack_what_is_not_needed() {
    let end: StageEnd = from_value(json!({})).unwrap();
    assert_eq!(end, StageEnd::default());
    let end: StageEnd = from_value(json!({ "status": "negative", "reason": "no" })).unwrap();
    assert_eq!((end.status, end.reason.as_deref()), (Some(StageStatus::Negative), Some("no")));
    let plan: PlanOutcome = from_value(json!({ "end": "tired", "more": [1] })).unwrap();
    assert_eq!(plan.end, Some(StatedEnd::Foreign("tired".into())));
    let plan: PlanOutcome = from_value(json!({ "end": "optimal", "report": {} })).unwrap();
    assert_eq!(plan.end, Some(StatedEnd::Known(End::Optimal)));
    let servo: ServoOutcome = from_value(json!({ "rms_nm": 1.0 })).unwrap();
    assert_eq!(servo.servos, None);
    let specification: SpecificationOutcome = from_value(json!({ "height": 1 })).unwrap();
    assert_eq!(specification.specification, None);
    let removal = from_value::<RemovalOutcome>(json!({ "total_time_s": 1.0 }));
    assert!(removal.unwrap_err().to_string().contains("missing field `rms_nm`"));
    assert_eq!(PlanStatus::of_solver(None).state, State::Unknown);
}

#[test]
fn a_value_that_json_cannot_hold_is_read_back() {
    let limit = json!({ "quantity": "radius", "unit": "m", "value": null, "limit": 2.0, "bound": "at-least",
        "passed": true, "worst": null });
    let report = json!({ "specification": { "name": "a", "passed": true, "limits": [limit] } });
    let read: SpecificationOutcome = from_value(report).unwrap();
    assert_eq!(read.specification.unwrap().limits[0].value, f64::INFINITY);
    // A gap that is not finite proves nothing.
    let gap = ProvenGap { relative_gap: Some(f64::INFINITY), ..ProvenGap::default() };
    assert_eq!(json!(gap), json!({ "relative_gap": null }));
    let read: ProvenGap = from_value(json!(gap)).unwrap();
    assert_eq!(read.relative_gap, None);
}
