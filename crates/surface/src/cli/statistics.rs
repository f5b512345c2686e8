//! `planish surface statistics`.

use clap::Args;
use planish_handoff::{Failure, Inputs, Status, say};
use planish_surface::{Family, statistics::surface_statistics};

use super::{CIRCLE, MapArgs, circle};

#[derive(Debug, Args)]
pub struct StatisticsArgs {
    #[command(flatten)]
    map: MapArgs,
    /// Terms of the fit in the robust PV [default: zernike if the circle about the valid pixels is
    /// smaller than their rectangle, else legendre]
    #[arg(long, value_enum)]
    pvr_terms: Option<Family>,
    /// Unit circle of the zernike terms, mm [default: about the valid pixels]
    #[arg(long, num_args = 3, value_names = CIRCLE, allow_negative_numbers = true)]
    zernike_circle_mm: Option<Vec<f64>>,
}

impl StatisticsArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let surface = self.map.read(&mut Inputs::new())?;
        let circle = self.zernike_circle_mm.as_deref().map(circle);
        let statistics = surface_statistics(&surface, self.pvr_terms, circle)?;
        say(serde_json::to_string_pretty(&statistics)?);
        Ok(Status::Done)
    }
}
