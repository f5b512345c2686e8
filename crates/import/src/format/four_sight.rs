//! 4D Technology 4Sight `.h5`: HDF5 with the map in `measurement0/genraw/data`.
//!
//! ```text
//! height (waves) = raw
//! ```
//!
//! The attributes of the group `genraw` are `wavelength` ("632.8 nm"), `xpix` ("0.5 mm"), `height_units` ("wv"), `aspect` and
//! `wedge`. Values beyond 1e38 are invalid. The first row is the top. Three public readers agree on this, and none of
//! them applies `wedge`; the vendor has no public description. Source: public readers of 4Sight files for FizCam and
//! PhaseCam, which state the factor, the invalid value and the orientation.

use hdf5_reader::{Attribute, Hdf5File, group::Group};
use planish_types::Invalid;
use serde_json::json;

use super::{
    hdf5::{MOST_VALUES, attribute_numbers, broken, is_single, matrix, open},
    short,
};
use crate::{
    Format, Unit,
    arrays::leaf,
    budget::MOST_ARRAYS,
    reading::{FirstRow, Pick, Reading},
};

const NAME: &str = "4Sight file";
const DATA: &str = "measurement0/genraw/data";

/// Smallest magnitude of a stored value that marks an invalid pixel.
const INVALID: f64 = 1e38;

/// Returns true if the file is HDF5 and has a map at the path of 4Sight.
pub(crate) fn is_four_sight(bytes: &[u8]) -> bool {
    open(bytes).is_ok_and(|file| file.dataset(DATA).is_ok())
}

/// Returns the path of the map that the user names, or that of the map of `measurement0`. Refuses several measurements
/// without a name.
fn path(file: &Hdf5File, pick: &Pick) -> Result<String, Invalid> {
    let root = file.root_group().map_err(broken)?;
    let (groups, _) = root.member_names().map_err(broken)?;
    let named = groups.iter().take(MOST_ARRAYS).map(|name| leaf(name));
    let measurements: Vec<&str> = named.filter(|name| name.starts_with("measurement")).collect();
    match &pick.dataset {
        Some(path) => Ok(path.trim_start_matches('/').to_string()),
        None if measurements.len() > 1 => {
            let listed = measurements.iter().take(20).copied().collect::<Vec<_>>().join(", ");
            let problem = format!("holds {} measurements: {listed}", measurements.len());
            let remedy = "choose one with `dataset`, such as measurement0/genraw/data";
            Err(Invalid::whole(NAME, problem, remedy))
        }
        None => Ok(DATA.to_string()),
    }
}

/// Returns the number and the unit in an attribute such as "632.8 nm"; `None` if it is absent. Refuses a number that is
/// not positive, and a word that is no unit of a map.
fn length(group: &Group, name: &str) -> Result<Option<(f64, Unit)>, Invalid> {
    let Some(text) = attribute_text(group, name)? else { return Ok(None) };
    if let Some((value, unit)) = text.trim().split_once(char::is_whitespace)
        && let Ok(value) = value.parse::<f64>()
        && value.is_finite()
        && value > 0.0
    {
        return Ok(Some((value, Unit::stated("unit", unit)?)));
    }
    let problem = format!("has {name} = \"{}\"", short(&text));
    Err(Invalid::whole(NAME, problem, "export it again from 4Sight"))
}

/// Returns the number of an attribute; `None` if it is absent, no number or not finite.
fn number(group: &Group, name: &str) -> Result<Option<f64>, Invalid> {
    let Some(attribute) = group_attribute(group, name)? else { return Ok(None) };
    Ok(attribute_numbers(&attribute).and_then(|v| v.first().copied()).filter(|v| v.is_finite()))
}

/// Reads the map of the only measurement, or the one that `pick.dataset` names.
///
/// # Errors
/// Refuses damaged files, several measurements without a name, names of coordinates or of a mask, and a wavelength or
/// pitch that is no length.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    if pick.x.is_some() || pick.y.is_some() || pick.mask.is_some() {
        let remedy = "leave out `x`, `y` and `mask`, or give `format` hdf5 for one array";
        return Err(Invalid::whole(NAME, "has its pitch and marks invalid pixels", remedy));
    }
    let file = open(bytes)?;
    let path = path(&file, pick)?;
    let set = file.dataset(&path).map_err(broken)?;
    let values = matrix(&set, false)?;
    let group_path = path.rsplit_once('/').map_or("", |split| split.0);
    let group = file.group(group_path).map_err(broken)?;

    let mut reading = Reading::new(Format::FourSight, values, FirstRow::Top);
    reading.single = is_single(&set);
    reading.values.mapv_inplace(|v| if v.abs() >= INVALID { f64::NAN } else { v });
    let unit = attribute_text(&group, "height_units")?;
    reading.unit = match unit.as_deref().map(str::trim) {
        Some(name) => Some(Unit::stated("height_units", name)?),
        None => None,
    };
    if let Some((value, unit)) = length(&group, "wavelength")? {
        // mm to nm
        reading.wavelength_nm = Some(value * (unit.mm()? * 1e6));
    }
    let aspect = number(&group, "aspect")?.unwrap_or(1.0);
    if let Some((value, unit)) = length(&group, "xpix")? {
        let mm = value * unit.mm()?;
        if aspect == 1.0 {
            reading.pixel_mm = Some([mm; 2]);
        } else {
            let say =
                format!("xpix {mm} mm is not used: the pixels are not square (aspect {aspect})");
            reading.warnings.push(say);
        }
    }
    let wedge = number(&group, "wedge")?;
    if let Some(wedge) = wedge.filter(|w| *w != 1.0) {
        let say = format!(
            "the file states the wedge factor {wedge}, which public readers do not apply: compare the heights with 4Sight, \
             and give `surface_per_value` where they differ"
        );
        reading.warnings.push(say);
    }
    let kind = attribute_text(&group, "lut_type")?.map(|kind| short(&kind));
    reading.stated = json!({
        "dataset": path,
        "wavelength_nm": reading.wavelength_nm,
        "height_units": unit.map(|u| short(&u)),
        "aspect": aspect,
        "wedge": wedge,
        "lut_type": kind,
    });
    Ok(reading)
}

/// Returns an attribute of a group; `None` if it is absent. Refuses a group in which any attribute has too many values,
/// because each may point to a long text.
fn group_attribute(group: &Group, name: &str) -> Result<Option<Attribute>, Invalid> {
    let raw = group.raw_attributes().map_err(broken)?;
    for attribute in &raw {
        let count = attribute.message().dataspace.num_elements().map_err(|e| broken(e.into()))?;
        if count > MOST_VALUES {
            let problem = format!("has {count} values of \"{}\"", short(attribute.name()));
            return Err(Invalid::whole(NAME, problem, "export it again from 4Sight"));
        }
    }
    if !raw.iter().any(|attribute| attribute.name() == name) {
        return Ok(None);
    }
    group.attribute(name).map(Some).map_err(broken)
}

/// Returns the text of an attribute; `None` if it is absent or empty.
fn attribute_text(group: &Group, name: &str) -> Result<Option<String>, Invalid> {
    let Some(attribute) = group_attribute(group, name)? else { return Ok(None) };
    Ok(attribute.read_strings().map_err(broken)?.into_iter().next())
}
