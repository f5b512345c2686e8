//! Flags of the file of a profile.

use std::path::Path;

use clap::Args;
use planish_handoff::{Failure, Inputs};
use planish_surface::profile::{LengthUnit, Profile, ProfileSettings, ValueUnit, rows_of_text};

/// Largest file of a profile, bytes; a larger one is refused. Larger: more memory for a file that is no
/// profile. Smaller: refuses long profiles. Chosen: room for some million lines.
const LARGEST_PROFILE_BYTES: u64 = 1 << 28;

/// Columns and units of the file of the flag `--profile`.
#[derive(Debug, Args)]
pub struct ProfileArgs {
    /// Columns of the profile's positions and of its values, from 1
    #[arg(long, num_args = 2, value_names = ["POSITION", "VALUE"], default_values_t = [1, 2], requires = "profile")]
    profile_columns: Vec<usize>,
    /// Unit of the profile's positions
    #[arg(long, value_enum, default_value = "mm", requires = "profile")]
    position_unit: LengthUnit,
    /// Unit of the profile's values: of a length for heights, of an angle for slopes
    #[arg(long, value_enum, requires = "profile")]
    value_unit: Option<ValueUnit>,
    /// Lines of the profile before its numbers [default: all that have none in both columns]
    #[arg(long, value_name = "N", requires = "profile")]
    header_lines: Option<usize>,
}

impl ProfileArgs {
    /// Reads a profile: a table as text, or a .npy file of shape (positions, columns).
    pub fn read(&self, inputs: &mut Inputs, file: &Path) -> Result<Profile, Failure> {
        let settings = self.settings()?;
        let rows = match file.extension().is_some_and(|e| e.eq_ignore_ascii_case("npy")) {
            true => {
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
                table.outer_iter().map(|row| [row[position - 1], row[value - 1]]).collect()
            }
            false => {
                let bytes = inputs.read_bytes("profile", file, LARGEST_PROFILE_BYTES)?;
                rows_of_text(&bytes, &settings).map_err(Failure::with_flags)?
            }
        };
        Profile::from_rows(&rows, &settings).map_err(Failure::with_flags)
    }

    /// Settings of the library from the flags.
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
