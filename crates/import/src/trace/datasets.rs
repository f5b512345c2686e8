//! HDF5: a dataset per quantity, or the columns of one.
//!
//! A dataset is named by its path, a column of a matrix by `PATH:K`, counted from 1. Its unit is the attribute
//! `unit` or `units`, where there is one.

use planish_types::Invalid;

use super::{
    NAME,
    columns::{Column, Columns, Log, Role, short, stated_unit},
    table::most_samples,
};
use crate::{budget::too_many, format::hdf5};

/// Reads the datasets that the user names. Refuses a file if those of x and y, or of all axes, are not named, and the
/// setpoint of one axis alone. Refuses datasets of different lengths (unless `time_y` is named), too many samples,
/// numbers that are not finite, and wrong units.
pub fn read(bytes: &[u8], requested: &Columns) -> Result<Log, Invalid> {
    let file = hdf5::open(bytes)?;
    let transposed = bytes.starts_with(b"MATLAB 7.3");
    let mut columns: Vec<Column> = Vec::new();
    for role in requested.roles() {
        let Some(name) = requested.requested(role) else {
            if matches!(role, Role::X | Role::Y | Role::Axis(_)) {
                let problem = format!("has no dataset that is known as {}", requested.name(role));
                let remedy = format!(
                    "{}, the path of a dataset, or PATH:K for column K of one",
                    requested.remedy(role)
                );
                return Err(Invalid::whole(NAME, problem, remedy));
            }
            continue;
        };
        let column = column(&file, role, name, transposed, requested)?;
        // The times of y may be others than those of x, and so may be their number.
        if let Some(first) = columns.first()
            && first.values.len() != column.values.len()
            && requested.time_y.is_none()
        {
            let problem = format!(
                "{} has {} samples, {} has {}",
                short(&first.name),
                first.values.len(),
                short(name),
                column.values.len()
            );
            return Err(Invalid::whole(NAME, problem, "give datasets of the same length"));
        }
        columns.push(column);
    }
    if requested.setpoint_x.is_some() != requested.setpoint_y.is_some() {
        let problem = "was asked for the setpoint of one axis";
        return Err(Invalid::whole(NAME, problem, "give `setpoint_x` and `setpoint_y`"));
    }
    let own = columns.iter().position(|column| column.role == Role::TimeY);
    let times: Vec<Column> = own.map(|own| columns.remove(own)).into_iter().collect();
    for column in columns.iter_mut().filter(|c| matches!(c.role, Role::Y | Role::SetpointY)) {
        column.own_time = own.map(|_| 0);
    }
    Ok(Log { columns, times, warnings: Vec::new() })
}

/// Reads the column of a quantity. `name` is the path of a dataset, or `PATH:K` for column K (counted from 1) of a
/// matrix. `transposed` is true for files of MATLAB, which store matrices transposed. Refuses a matrix of several
/// columns without K, and what `read` refuses.
fn column(
    file: &hdf5_reader::Hdf5File,
    role: Role,
    name: &str,
    transposed: bool,
    requested: &Columns,
) -> Result<Column, Invalid> {
    let (path, which) = match name.rsplit_once(':') {
        Some((path, number)) => (path, Some(number)),
        None => (name, None),
    };
    let set = file.dataset(path).map_err(hdf5::broken)?;
    let matrix = hdf5::matrix(&set, transposed)?;
    let (rows, columns) = matrix.dim();
    let values: Vec<f64> = match which.map(str::parse::<usize>) {
        None if rows == 1 || columns == 1 => matrix.iter().copied().collect(),
        Some(Ok(k)) if (1..=columns).contains(&k) => matrix.column(k - 1).to_vec(),
        _ => {
            let problem = format!("is {}, of {rows} rows x {columns} columns", short(name));
            return Err(Invalid::whole(role.setting(), problem, "give PATH:K for column K of it"));
        }
    };
    if values.len() > most_samples() {
        return Err(too_many(NAME, most_samples(), "samples", "cut it"));
    }
    if let Some(i) = values.iter().position(|v| !v.is_finite()) {
        let problem = format!("is {} in {}", values[i], short(name));
        return Err(Invalid::at_index(
            role.setting(),
            i,
            problem,
            "cut the log where it is damaged",
        ));
    }
    let unit = match hdf5::unit_text(&set)? {
        Some(word) => stated_unit(role, requested, &word, true)?,
        None => stated_unit(role, requested, name, false)?,
    };
    if !role.is_time() {
        return Ok(Column::of_values(role, name.to_string(), unit, values));
    }
    // A double is known to its last bit: times since 1970 are rounded.
    let largest = values.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
    let first = values.first().copied().unwrap_or(0.0);
    Ok(Column {
        first,
        resolution: largest * f64::EPSILON,
        ..Column::of_values(
            role,
            name.to_string(),
            unit,
            values.iter().map(|v| v - first).collect(),
        )
    })
}
