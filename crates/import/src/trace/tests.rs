use super::*;

fn settings() -> TraceSettings {
    TraceSettings { most_gap_s: 0.1, ..TraceSettings::default() }
}

fn said(text: &str, settings: &TraceSettings) -> String {
    read(LogFormat::Csv, text.as_bytes(), settings).unwrap_err().to_string()
}

const LOG: &str = "t_ms,x,y,setpoint x,setpoint y,current,tool on\n\
                   0,0,10,0,11,2,0\n10,1,10,2,11,4,1\n20,2,10,3,11,-0.01,1\n30,3,10,4,11,2,1\n";

#[test]
fn a_log_in_counts_with_its_current() {
    let settings = TraceSettings {
        unit: Unit::read("count", &[]),
        count_mm: Some([1e-3, -2e-3]),
        nominal_current: Some(4.0),
        ..settings()
    };
    let trace = read(LogFormat::Csv, LOG.as_bytes(), &settings).unwrap();
    assert_eq!(trace.actual_mm[3], [3e-3, -2e-2]);
    assert_eq!(trace.setpoint_mm.as_ref().unwrap()[1], [2e-3, -2.2e-2]);
    assert_eq!(trace.rate_factor.as_deref(), Some(&[0.5, 1.0, 0.0, 0.5][..]));
    assert_eq!(trace.tool_on.as_deref(), Some(&[false, true, true, true][..]));
    assert!(trace.statement.warnings.iter().any(|w| w.contains("below zero in 1 samples")));
    let motion = trace.motion(Between::Cubic).unwrap();
    assert_eq!(motion.rate_factor(), Some(&[0.75, 0.5, 0.25][..]));
    assert_eq!(motion.tool_on(), [false, true, true]);
    // Rounding of 0.03 s.
    assert!((motion.total_time_s() - 0.03).abs() < 1e-15);
    let cut = TraceSettings { from_s: Some(0.005), until_s: Some(0.02), ..settings };
    let trace = read(LogFormat::Csv, LOG.as_bytes(), &cut).unwrap();
    assert_eq!((trace.time_s.len(), trace.actual_mm[0][0]), (2, 1e-3));
}

#[test]
fn what_a_log_does_not_say_is_asked_for() {
    let log = |unit, nominal_current| TraceSettings { unit, nominal_current, ..settings() };
    assert!(said(LOG, &log(None, Some(1.0))).contains("unit: of the positions is not in the log"));
    let counts = said(LOG, &log(Unit::read("count", &[]), Some(1.0)));
    assert!(counts.contains("count_mm: is not in a log in counts"), "{counts}");
    let current = said(LOG, &log(Unit::read("mm", &[]), None));
    assert!(current.contains("nominal_current: is not in a log"), "{current}");
    let negative = said(LOG, &log(Unit::read("mm", &[]), Some(0.1)));
    assert!(negative.contains("current[2]: is -0.01, with the nominal current 0.1"), "{negative}");
    let without = said("x_mm,y_mm\n1,2\n1,2\n", &log(Unit::read("mm", &[]), None));
    assert!(without.contains("rate_hz: is not in a log"), "{without}");
    let rate = TraceSettings { rate_hz: Some(1e3), ..log(Unit::read("mm", &[]), None) };
    let contradicts = said("x_um,y_um\n1,2\n1,2\n", &rate);
    assert!(contradicts.contains("unit: is mm, but the log has \"x_um\" in um"), "{contradicts}");
    let far = said("x_m,y_m\n1,2\n3e6,2\n", &TraceSettings { unit: None, ..rate.clone() });
    assert!(far.contains("position[1]"), "{far}");
    let one = said("x_m,y_m\n1,2\n", &TraceSettings { unit: None, ..rate });
    assert!(one.contains("holds 1 samples"), "{one}");
}
