//! The subcommands of `planish refine`, one file each, and the code that they share.

mod pareto;
mod refine;

use clap::Subcommand;
use ndarray::{Array1, Array2};
use planish_handoff::{Failure, Status, npy::ArrayData};
use planish_refine::Iterate;

pub use refine::Refine;

#[derive(Subcommand)]
pub enum RefineCommand {
    /// Plan at rising prices of a second: residual against total time
    Pareto(pareto::Pareto),
}

impl RefineCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Pareto(arguments) => arguments.run(),
        }
    }
}

/// Returns the arrays of the artifact `kind::ITERATIONS` from at least one iterate: dwell times, RMS values, total
/// times and stretched segments.
fn iterations<'a>(iterates: impl Iterator<Item = &'a Iterate>) -> Vec<ArrayData<'a>> {
    let iterates: Vec<&Iterate> = iterates.collect();
    let shape = (iterates.len(), iterates[0].dwell_s.len());
    let dwell = Array2::from_shape_fn(shape, |(i, j)| iterates[i].dwell_s[j]);
    let rms: Array1<f64> = iterates.iter().map(|i| i.rms_nm).collect();
    let times: Array1<f64> = iterates.iter().map(|i| i.total_time_s).collect();
    let stretched: Array1<i64> = iterates.iter().map(|i| i.stretched as i64).collect();
    vec![
        ArrayData::F64(dwell.into_dyn().into()),
        ArrayData::F64(rms.into_dyn().into()),
        ArrayData::F64(times.into_dyn().into()),
        ArrayData::I64(stretched.into_dyn().into()),
    ]
}
