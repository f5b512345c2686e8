//! The published run of the reference mirror, reconciled with the published plan, where `PLANISH_REFERENCE` names its
//! folder. `cargo test -p planish-testkit --test all reconcile:: -- --nocapture` prints the numbers of docs/campaign.md.

use planish_reconcile::{Comparison, ReconcileSettings, Reconciled, reconcile};
use planish_schedule::pvt;
use planish_testkit::{
    ion_beam,
    mirror::{Mirror, mirror},
};
use planish_types::{Surface, text::significant};

fn learnt(mirror: &Mirror, path: &str, settings: &ReconcileSettings) -> Reconciled {
    let how = pvt::PvtSettings::new(pvt::Mode::Monotone);
    let trajectory = pvt::schedule(&mirror.path(path), &mirror.dwell(path), &ion_beam(), &how);
    let trajectory = trajectory.unwrap().trajectory;
    let after = mirror.map("after_ibf_measured_nm");
    let after = Surface::new(*mirror.desired.grid(), after).unwrap();
    let comparison = Comparison {
        before: &mirror.desired,
        after: &after,
        trajectory: &trajectory,
        tif: &mirror.tif,
        error_budget: None,
        transform: None,
    };
    let settings = ReconcileSettings { same_measurement: true, ..settings.clone() };
    let found = reconcile(&comparison, &settings).unwrap();
    println!("{path}, {settings:?}");
    for e in found.outcome.parameters.iter().filter(|e| !e.held) {
        let error = e.standard_error.map_or("-".into(), |v| significant(v, 3));
        match (&e.refused, e.value) {
            (Some(reason), _) => println!("  {:<26} +- {error} {}: {reason}", e.name, e.unit),
            (_, Some(v)) => {
                println!("  {:<26} {} +- {error} {}", e.name, significant(v, 3), e.unit)
            }
            (None, None) => {}
        }
    }
    println!("  {:?}\n  {:?}", found.outcome.fitted, found.outcome.noise);
    found
}

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|n| n.to_string()).collect()
}

/// The rate is that of the plan within two of its standard errors. Which number a displacement has depends on what the
/// metrology is said to know: no fit may give one that another contradicts.
#[test]
fn the_published_run_teaches_a_rate_and_no_displacement() {
    let Some(mirror) = mirror() else { return };
    let few = names(&["rate_scale", "offset_x", "offset_y"]);
    let settings = |hold: &[&str], order| ReconcileSettings {
        free: few.clone(),
        hold: names(hold),
        metrology_order: order,
        ..ReconcileSettings::default()
    };
    let alone = learnt(&mirror, "raster", &settings(&["tilt_x", "tilt_y", "power"], None));
    learnt(&mirror, "raster", &settings(&["power"], None));
    learnt(&mirror, "raster", &settings(&[], Some([4, 3])));
    let highest = learnt(&mirror, "raster", &settings(&[], Some([8, 6])));
    learnt(&mirror, "raster", &ReconcileSettings::default());
    learnt(&mirror, "maze", &ReconcileSettings::default());
    let rate = |found: &Reconciled| found.outcome.parameters[0].clone();
    let found = rate(&alone);
    if let (Some(value), Some(error)) = (found.value, found.standard_error) {
        assert!(value.abs() < 2.0 * error, "{found:?}");
    }
    // The removal of a mirror this flat is a few Legendre terms: with those up to 8 x 6 free nothing tells its scale.
    assert!(rate(&highest).refused.is_some(), "{:?}", rate(&highest));
    assert!(highest.drawback.is_some());
}
