//! MetroPro `.dat`: a header, the intensity, the phase.
//!
//! ```text
//! height (m) = raw W S O / R, negative where the sign word is not 0
//! ```
//!
//! | symbol | field | offset | type |
//! |---|---|---|---|
//! | W | wavelength, m | 168 | f32 |
//! | S | interferometric scale factor (0.5: reflected once) | 164 | f32 |
//! | O | obliquity factor | 176 | f32 |
//! | R | 4096, 32768, 131072 for the resolution word 0, 1, 2 | 218 | i16 |
//! | sign | sign word | 232 | i16 |
//! | - | lateral resolution, m; 0 = not calibrated | 184 | f32 |
//! | - | first column and row of the phase in the camera | 64, 66 | i16 |
//! | - | rows of the camera | 236 | i16 |
//!
//! All of these are big-endian. With S the height is that of the surface, not of the wavefront.
//! Published readers disagree about R (one is off by a factor of 8) and about the sign word (half of
//! them ignore it); this follows the majority and the vendor. The first row of the file is the top
//! of the picture.

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::check_size,
    bytes::{Bytes, Number},
    reading::{FirstRow, Reading, Window},
};

const NAME: &str = "MetroPro file";

/// Magic number, format number and header size (bytes) of the three versions of the format. A file must have all three
/// of one version.
const HEADERS: [(u32, u16, u32); 3] =
    [(0x881B_036F, 1, 834), (0x881B_0370, 2, 834), (0x881B_0371, 3, 4096)];

/// Smallest stored value that marks an invalid pixel (MetroPro reference guide).
const INVALID: f64 = 2_147_483_640.0;

/// Returns true if the bytes begin as a MetroPro file does.
pub(crate) fn is_magic(bytes: &[u8]) -> bool {
    bytes.first_chunk().is_some_and(|b| HEADERS.iter().any(|h| h.0 == u32::from_be_bytes(*b)))
}

/// Returns the message about a damaged MetroPro file.
fn bad(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "export it again from the instrument")
}

/// Returns the 32-bit float at byte `place`, called `name` in messages. Refuses a number that is not finite and
/// positive.
fn positive(b: &Bytes<'_>, name: &str, place: usize) -> Result<f64, Invalid> {
    let v = f64::from(b.f32(place)?);
    if v.is_finite() && v > 0.0 { Ok(v) } else { Err(bad(format!("has the {name} {v}"))) }
}

/// Returns the divisor R of the module for the phase resolution word of the header: 0, 1 or 2. Refuses other words.
fn resolution(word: i16) -> Result<f64, Invalid> {
    match word {
        0 => Ok(4096.0),
        1 => Ok(32768.0),
        2 => Ok(131_072.0),
        other => Err(bad(format!("has the phase resolution word {other}, not 0, 1 or 2"))),
    }
}

/// Reads the phase as a map of heights. Refuses damaged files, files without phase, and a wavelength or factor that is
/// not positive.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let b = Bytes { all: bytes, name: NAME, big_endian: true };

    let (magic, format, size) = (b.u32(0)?, b.u16(4)?, b.u32(6)?);
    if !HEADERS.contains(&(magic, format, size)) {
        let problem =
            format!("starts with magic {magic:08X}, header format {format}, header size {size}");
        return Err(Invalid::whole(NAME, problem, "MetroPro writes 881B036F .. 881B0371"));
    }
    let header = size as usize;
    b.slice(0, header)?;

    let columns = usize::from(b.u16(68)?);
    let rows = usize::from(b.u16(70)?);
    if rows == 0 || columns == 0 {
        return Err(bad("holds no phase, only intensity".into()));
    }
    let count = check_size("phase", rows, columns)?;
    let intensity = b.u32(60)? as usize;
    let phase = b.u32(72)? as usize;
    if phase != 4 * count {
        return Err(bad(format!(
            "says that {rows} x {columns} pixels of phase take {phase} bytes; they take {}",
            4 * count
        )));
    }
    let raw = b.slice(header + intensity, phase)?;

    let scale = positive(&b, "interferometric scale factor", 164)?;
    let wavelength_m = positive(&b, "wavelength in m", 168)?;
    let obliquity = positive(&b, "obliquity factor", 176)?;
    let resolution_word = b.i16(218)?;
    let resolution = resolution(resolution_word)?;
    let sign_word = b.i16(232)?;
    let sign = if sign_word == 0 { 1.0 } else { -1.0 };
    let lateral_m = f64::from(b.f32(184)?);
    if !(lateral_m.is_finite() && lateral_m >= 0.0) {
        return Err(bad(format!("has the lateral resolution {lateral_m} m")));
    }

    let mut values = Number::I32.decode(raw, count, true)?;
    for v in values.iter_mut().filter(|v| **v >= INVALID) {
        *v = f64::NAN;
    }
    let values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");
    let mut reading = Reading::new(Format::Metropro, values, FirstRow::Top);
    reading.unit = Some(Unit::named("m"));
    // z = raw W S O / R
    reading.factor = sign * (wavelength_m * scale * obliquity / resolution);
    reading.scale_applied = Some(scale);
    reading.wavelength_nm = Some(wavelength_m * 1e9);
    if lateral_m > 0.0 {
        reading.pixel_mm = Some([lateral_m * 1e3; 2]);
    }
    let first = [f64::from(b.i16(64)?), f64::from(b.i16(66)?)];
    let camera_rows = Some(f64::from(b.i16(236)?)).filter(|n| *n >= first[1] + rows as f64);
    reading.window = Some(Window { first, in_mm: false, frame_rows: camera_rows });
    if sign_word != 0 {
        reading.warnings.push(format!("the sign word is {sign_word}: the heights are negated"));
    }
    reading.stated = json!({
        "header_format": format,
        "interferometric_scale_factor": scale,
        "wavelength_nm": wavelength_m * 1e9,
        "obliquity_factor": obliquity,
        "phase_resolution": resolution,
        "sign_word": sign_word,
        "lateral_resolution_um": lateral_m * 1e6,
        "origin_pixel": [b.i16(64)?, b.i16(66)?],
        "part_name": b.text(258, 40)?,
        "part_serial_number": b.text(320, 40)?,
        "comment": b.text(80, 82)?,
        "system_error_subtracted": b.i16(302)? != 0,
    });
    Ok(reading)
}
