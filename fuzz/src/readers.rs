//! Everything that reads bytes of somebody else, each as a function that must return: no panic, no
//! abort, no endless loop, no more memory than [`MEMORY_GIB`], whatever the bytes are.
//!
//! Here for the fuzzer, and for `crates/import/tests/corpus.rs`, which replays the corpus.

use planish_handoff::{Manifest, kind::Dtype, npy};
use planish_import::{
    Format, Origin, Pick, ReadingSettings, Unit,
    program::{self, Configuration, ProgramAxis},
    read, surface, tif,
    trace::{self, LogFormat, TraceSettings, following, motion::Between},
};
use planish_types::{ControllerKind, MachineFile, budget, units};

/// What a reader may take: an input of some kilobytes that needs more is a defect.
pub const MEMORY_GIB: f64 = 1.0 / 16.0;

/// Longest message of an error, characters: a person reads it.
const LONGEST_MESSAGE: usize = 1500;

/// A reader by its name, which is that of its corpus.
pub type Reader = (&'static str, fn(&[u8]));

/// Every reader.
pub const READERS: [Reader; 27] = [
    ("metropro", |bytes| map(Format::Metropro, bytes)),
    ("datx", |bytes| map(Format::Datx, bytes)),
    ("xyz", |bytes| map(Format::Xyz, bytes)),
    ("mat5", |bytes| map(Format::Mat5, bytes)),
    ("hdf5", |bytes| map(Format::Hdf5, bytes)),
    ("fits", |bytes| map(Format::Fits, bytes)),
    ("csv", |bytes| map(Format::Csv, bytes)),
    ("npy", |bytes| map(Format::Npy, bytes)),
    ("sdf", |bytes| map(Format::Sdf, bytes)),
    ("gsf", |bytes| map(Format::Gsf, bytes)),
    ("gwy", |bytes| map(Format::Gwy, bytes)),
    ("sur", |bytes| map(Format::Sur, bytes)),
    ("codev", |bytes| map(Format::CodevInt, bytes)),
    ("grid-sag", |bytes| map(Format::GridSag, bytes)),
    ("x3p", |bytes| map(Format::X3p, bytes)),
    ("opd", |bytes| map(Format::Opd, bytes)),
    ("npz", |bytes| map(Format::Npz, bytes)),
    ("srw", |bytes| map(Format::Srw, bytes)),
    ("wft", |bytes| map(Format::Wft, bytes)),
    ("presurface", |bytes| map(Format::Presurface, bytes)),
    ("4sight", |bytes| map(Format::FourSight, bytes)),
    ("scattered", scattered),
    ("program", programs),
    ("trace", log),
    ("artifact-npy", artifact_npy),
    ("manifest", manifest),
    ("machine", machine),
];

/// Sets the budget of this process.
pub fn prepare() {
    budget::set_memory_gib(MEMORY_GIB).expect("the budget is positive");
}

/// A map: as a surface and as a TIF, with everything given that a file may leave out.
fn map(format: Format, bytes: &[u8]) {
    let _ = Format::recognise(bytes);
    for is_tif in [false, true] {
        let pick = Pick { is_tif, ..Pick::default() };
        let reading = match read(format, bytes, &pick) {
            Ok(reading) => reading,
            Err(error) => return readable(&error.to_string()),
        };
        let settings = ReadingSettings {
            override_file: true,
            unit: reading.unit.or(Some(Unit::named("nm"))),
            wavelength_nm: reading.wavelength_nm.or(Some(632.8)),
            pixel_mm: reading.coordinates.is_none().then_some([0.5, 0.25]),
            coordinate_unit: reading
                .coordinates
                .as_ref()
                .map(|coordinates| coordinates.unit.unwrap_or(Unit::named("mm"))),
            origin: Origin::Centre,
            ..ReadingSettings::default()
        };
        let made = match is_tif {
            false => surface(reading, &settings).map(|made| made.1),
            true => tif(reading, &settings).map(|made| made.1),
        };
        match made {
            // Nothing that JSON does not have gets into a manifest.
            Ok(statement) => assert!(statement.nm_per_value.is_finite()),
            Err(error) => readable(&error.to_string()),
        }
    }
}

/// Points that are gridded.
fn scattered(bytes: &[u8]) {
    let pick = Pick {
        grid_mm: Some([0.5, 0.25]),
        coordinate_unit: Some(Unit::named("mm")),
        ..Pick::default()
    };
    if let Err(error) = read(Format::Xyz, bytes, &pick) {
        readable(&error.to_string());
    }
}

/// A program, by the reader of every controller: a user may name the wrong one.
fn programs(bytes: &[u8]) {
    ControllerKind::ALL.into_iter().for_each(|controller| motion(controller, bytes));
}

fn motion(controller: ControllerKind, bytes: &[u8]) {
    let configuration = Configuration {
        start_mm: Some([0.0; 2]),
        count_mm: Some([1e-3; 2]),
        sample_s: Some(1e-3),
        feedrate_time_unit_s: Some(1.0),
        ..Configuration::default()
    };
    match program::read(controller, bytes, &configuration) {
        Ok(motion) => assert!(motion.total_time_s().is_finite()),
        Err(error) => readable(&error.to_string()),
    }
    let axis = |name: &str, unit: &str| ProgramAxis {
        name: name.into(),
        unit: unit.into(),
        start: 0.0,
        count: 1e-3,
    };
    let of_axes = Configuration {
        start_mm: None,
        count_mm: None,
        axes: vec![axis("r", "mm"), axis("z", "mm"), axis("c", "deg")],
        ..configuration
    };
    match program::read_axes(controller, bytes, &of_axes) {
        Ok(motion) => assert!(motion.total_time_s().is_finite()),
        Err(error) => readable(&error.to_string()),
    }
}

/// A log in every format, with everything given that it may leave out.
fn log(bytes: &[u8]) {
    let formats = [LogFormat::Csv, LogFormat::Xps, LogFormat::Aerotech, LogFormat::Galil];
    let formats = match LogFormat::recognise(bytes, None) {
        Some(format) => vec![format],
        None => formats.to_vec(),
    };
    for format in formats {
        let mut settings = TraceSettings {
            count_mm: Some([1e-3; 2]),
            sample_s: Some(1e-3),
            rate_hz: Some(1e3),
            most_gap_s: 1.0,
            nominal_current: Some(1.0),
            unit: units::Unit::read("mm", &[]),
            time_unit: units::Unit::read("ms", &[]),
            ..TraceSettings::default()
        };
        if format == LogFormat::Hdf5 {
            (settings.columns.x, settings.columns.y) = (Some("x".into()), Some("y".into()));
        }
        let mut read = trace::read(format, bytes, &settings);
        if read.is_err() {
            // Where the log states its units, others contradict it.
            (settings.unit, settings.time_unit) = (None, None);
            read = trace::read(format, bytes, &settings);
        }
        match read
            .and_then(|log| Ok((log.motion(Between::Cubic)?, log.setpoint(Between::Cubic)?, log)))
        {
            Ok((motion, setpoint, log)) => {
                assert!(motion.total_time_s().is_finite());
                let setpoint = setpoint.as_ref().unwrap_or(&motion);
                following::beside_setpoint(&log.time_s, &log.actual_mm, setpoint);
            }
            Err(error) => readable(&error.to_string()),
        }
    }
}

fn artifact_npy(bytes: &[u8]) {
    for dtype in [Dtype::F64, Dtype::I64, Dtype::U8] {
        if let Err(message) = npy::parse(bytes, dtype) {
            readable(&message);
        }
    }
}

fn manifest(bytes: &[u8]) {
    if let Ok(manifest) = serde_json::from_slice::<Manifest>(bytes) {
        serde_json::to_vec(&manifest).expect("what was read can be written");
    }
}

fn machine(bytes: &[u8]) {
    if let Ok(file) = serde_json::from_slice::<MachineFile>(bytes)
        && let Err(error) = file.checked()
    {
        readable(&error.to_string());
    }
}

/// An error is one short message for a person.
fn readable(message: &str) {
    assert!(message.chars().count() < LONGEST_MESSAGE, "{message}");
}
