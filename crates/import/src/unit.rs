//! Units of heights, removal rates, slopes and coordinates, by the table of all readers ([`planish_types::units`]).

use std::{fmt, str::FromStr};

use planish_types::{
    Invalid,
    units::{self, Header, Quantity},
};
use serde::{Serialize, Serializer};

/// Quantities that the values of a map may have: heights or removal rates, in lengths or in wavelengths.
pub(crate) const VALUES: [Quantity; 4] =
    [Quantity::Length, Quantity::LengthPerTime, Quantity::Waves, Quantity::WavesPerTime];

/// Unit of the values of a map, or of its coordinates, from the table [`planish_types::units`].
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Unit(units::Unit);

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

impl fmt::Debug for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

impl Serialize for Unit {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&self.0)
    }
}

impl FromStr for Unit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        units::Unit::read(text, &VALUES).and_then(Self::checked).ok_or_else(|| {
            "give m, mm, um, nm, angstrom, in, mil, waves or another unit of length, over a time for a rate \
             (nm/s, nm/min, um/h), or pixels for coordinates"
                .to_string()
        })
    }
}

impl Unit {
    /// Returns the unit with this symbol, such as `nm`.
    ///
    /// # Panics
    /// Panics if the table has no such symbol.
    pub fn named(symbol: &'static str) -> Self {
        Self(units::Unit::read(symbol, &VALUES).expect("the table has the symbol"))
    }

    /// Returns the unit if the values or coordinates of a map can have it; `None` for other quantities.
    fn checked(unit: units::Unit) -> Option<Self> {
        let quantity = unit.quantity();
        let is_checked = VALUES.contains(&quantity) || quantity == Quantity::Pixels;
        if is_checked { Some(Self(unit)) } else { None }
    }

    /// Returns the unit that `text` spells, such as `um` or `nm/min`; `None` if it is none that the values or
    /// coordinates of a map can have.
    pub(crate) fn spelled(text: &str) -> Option<Self> {
        units::Unit::read(text, &VALUES).and_then(Self::checked)
    }

    /// Returns the unit that a file states as the word `name` in its field `place`.
    ///
    /// # Errors
    /// Refuses a word that is no unit of the values or coordinates of a map; the message quotes it.
    pub fn stated(place: &'static str, name: &str) -> Result<Self, Invalid> {
        let unit = units::Unit::read(name, &VALUES);
        if let Some(unit) = unit.and_then(Self::checked) {
            return Ok(unit);
        }
        let remedy = match unit.map(|unit| unit.quantity()) {
            Some(Quantity::Fringes) => {
                "the height of a fringe depends on the interferometer: give `unit` waves, `surface_per_value` and \
                 `override_file`"
            }
            Some(Quantity::Angle) => "slopes are read by planish import slopes",
            _ => {
                "a map of lengths or rates is needed: m, mm, um, nm, angstrom, in, mil or waves, a rate over s, min or h; \
                 where the word is wrong, give the unit and `override_file`"
            }
        };
        let short: String = name.chars().filter(|c| !c.is_control()).take(40).collect();
        Err(Invalid::whole(place, format!("is \"{short}\""), remedy))
    }

    /// Splits the name of a variable or column, such as `height_nm` or `z [um]`, into the name and the unit, which is
    /// `None` if the text states none.
    ///
    /// # Errors
    /// Refuses a word in the place of a unit (in brackets, after a slash or after "in") that is no unit of a map, and a
    /// unit of another quantity.
    pub(crate) fn of_name(text: &str) -> Result<(String, Option<Self>), Invalid> {
        let remedy = "rename the column, or delete its unit and give `unit` and `coordinate_unit`";
        let Header { name, unit } =
            Header::read(text, &VALUES).map_err(|e| e.refused("unit", remedy))?;
        match unit {
            None => Ok((name, None)),
            Some(unit) => match Self::checked(unit) {
                Some(unit) => Ok((name, Some(unit))),
                None => {
                    let short: String = text.chars().filter(|c| !c.is_control()).take(40).collect();
                    let problem = format!("is {unit} in \"{short}\", which is no unit of a map");
                    Err(Invalid::whole("unit", problem, remedy))
                }
            },
        }
    }

    /// Returns true if the unit is that of a rate: a length or wavelengths over a time.
    pub(crate) fn is_rate(self) -> bool {
        self.0.per_s().is_some()
    }

    /// Returns the unit without its time: `nm` for `nm/s`. A unit without a time stays as it is.
    pub(crate) fn without_time(self) -> Self {
        Self(self.0.numerator())
    }

    /// Returns true if the unit is the wavelength of the light, alone or over a time.
    pub(crate) fn is_waves(self) -> bool {
        self.0.numerator().quantity() == Quantity::Waves
    }

    /// Returns true if the unit is the pixel.
    pub(crate) fn is_pixels(self) -> bool {
        self.0.quantity() == Quantity::Pixels
    }

    /// Returns the size of the unit in nm, or in nm/s for a rate. `wavelength_nm` is that of the light, for waves.
    ///
    /// # Errors
    /// Refuses waves without a wavelength or with one that is not positive, and pixels.
    pub(crate) fn nm(self, wavelength_nm: Option<f64>) -> Result<f64, Invalid> {
        if self.is_pixels() {
            let remedy = "heights are lengths: give `unit`";
            return Err(Invalid::whole("unit", "of the heights is pixels", remedy));
        }
        if !self.is_waves() {
            return Ok(self.0.size(-9));
        }
        match wavelength_nm {
            Some(w) if w.is_finite() && w > 0.0 => Ok(w / self.0.per_s().unwrap_or(1.0)),
            Some(w) => {
                Err(Invalid::whole("wavelength_nm", format!("is {w}"), "give a length in nm"))
            }
            None => Err(Invalid::whole(
                "wavelength_nm",
                "is not in the file, whose heights are in waves",
                "give `wavelength_nm`",
            )),
        }
    }

    /// Returns the size of the unit of a coordinate in mm.
    ///
    /// # Errors
    /// Refuses a unit that is no length, such as pixels.
    pub(crate) fn mm(self) -> Result<f64, Invalid> {
        if self.0.quantity() == Quantity::Length {
            return Ok(self.0.size(-3));
        }
        let remedy = if self.is_pixels() {
            "give `pixel_mm`, the distance of pixel centres"
        } else {
            "coordinates are in m, mm, um, nm, in or another length, or in pixels"
        };
        Err(Invalid::whole("coordinate_unit", format!("is {self}"), remedy))
    }
}
