//! Flags of the file of a profile.

use std::path::Path;

use clap::Args;
use planish_handoff::{Failure, Inputs, warn};
use planish_surface::profile::{Profile, ProfileRows, ProfileSettings, rows_of_text};
use planish_types::units::{Quantity, Unit};

/// Largest file of a profile, bytes; a larger one is refused. Larger: more memory for a file that is no
/// profile. Smaller: refuses long profiles. Chosen: room for some million lines.
const LARGEST_PROFILE_BYTES: u64 = 1 << 28;

/// Columns and units of the file of the flag `--profile`.
#[derive(Debug, Args)]
pub struct ProfileArgs {
    /// Columns of the profile's positions and of its values, from 1
    #[arg(long, num_args = 2, value_names = ["POSITION", "VALUE"], default_values_t = [1, 2], requires = "profile")]
    profile_columns: Vec<usize>,
    /// Unit of the profile's positions, such as mm or in [default: the one that the file states, or mm]
    #[arg(long, value_name = "UNIT", value_parser = position_unit, requires = "profile")]
    position_unit: Option<Unit>,
    /// Unit of the profile's values: of a length for heights, such as nm, or of an angle for slopes, such as urad or arcsec
    #[arg(long, value_name = "UNIT", value_parser = value_unit, requires = "profile")]
    value_unit: Option<Unit>,
    /// Lines of the profile before its numbers [default: all that have none in both columns]
    #[arg(long, value_name = "N", requires = "profile")]
    header_lines: Option<usize>,
}

fn position_unit(text: &str) -> Result<Unit, String> {
    let unit = Unit::read(text, &[Quantity::Length]);
    let unit = unit.filter(|unit| unit.quantity() == Quantity::Length);
    unit.ok_or_else(|| "is no unit of a length, such as mm or in".into())
}

fn value_unit(text: &str) -> Result<Unit, String> {
    let wanted = [Quantity::Length, Quantity::Angle];
    let unit = Unit::read(text, &wanted).filter(|unit| wanted.contains(&unit.quantity()));
    unit.ok_or_else(|| "is no unit of a length or an angle, such as nm, um, urad or arcsec".into())
}

impl ProfileArgs {
    /// Reads a profile: a table as text, or a .npy file of shape (positions, columns). Refuses flags that do not
    /// describe it, and a file that is no profile.
    pub fn read(&self, inputs: &mut Inputs, file: &Path) -> Result<Profile, Failure> {
        let settings = self.settings()?;
        let rows = if file.extension().is_some_and(|e| e.eq_ignore_ascii_case("npy")) {
            let table = inputs.read_map("profile", file)?;
            let [position, value] = settings.columns;
            if position.max(value) > table.ncols() {
                let message = format!(
                    "{}: has {} column(s), not {}; give the right --profile-columns (an array of shape \
                         (positions, columns))",
                    file.display(),
                    table.ncols(),
                    position.max(value)
                );
                return Err(Failure::new(message));
            }
            let rows = table.outer_iter().map(|row| [row[position - 1], row[value - 1]]);
            ProfileRows { rows: rows.collect(), position_unit: None, warnings: Vec::new() }
        } else {
            let bytes = inputs.read_bytes("profile", file, LARGEST_PROFILE_BYTES)?;
            rows_of_text(&bytes, &settings).map_err(Failure::with_flags)?
        };
        rows.warnings.iter().for_each(warn);
        Profile::from_rows(&rows, &settings).map_err(Failure::with_flags)
    }

    /// Returns the settings of the library from the flags. Refuses equal columns, and no unit of the values.
    pub fn settings(&self) -> Result<ProfileSettings, Failure> {
        let columns = [self.profile_columns[0], self.profile_columns[1]];
        if columns.contains(&0) || columns[0] == columns[1] {
            let [position, value] = columns;
            let message = format!("--profile-columns: are {position} and {value}");
            return Err(Failure::new(format!("{message}; give two different ones, from 1")));
        }
        let Some(value_unit) = self.value_unit else {
            return Err(Failure::new(
                "--value-unit: is missing; say what the profile's values are in",
            ));
        };
        let Self { position_unit, header_lines, .. } = *self;
        Ok(ProfileSettings { columns, position_unit, value_unit, header_lines })
    }
}
