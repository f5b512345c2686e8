//! `planish surface psd`.

use clap::Args;
use ndarray::Array1;
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status, flags::OutputArgs, kind, npy::ArrayData, say, task,
};
use planish_surface::{
    draw::psd_svg,
    psd::{Detrend, Psd, PsdSettings, Window, psd},
};

use super::MapArgs;

#[derive(Debug, Args)]
pub struct PsdArgs {
    #[command(flatten)]
    map: MapArgs,
    /// Window along x and y
    #[arg(long, value_enum, default_value_t = Window::Hann)]
    window: Window,
    /// Function to subtract first
    #[arg(long, value_enum, default_value_t = Detrend::Plane)]
    detrend: Detrend,
    /// Band of spatial frequencies [F0, F1) for an RMS, 1/mm; may be repeated
    #[arg(long, num_args = 2, value_names = ["F0", "F1"], action = clap::ArgAction::Append, allow_negative_numbers = true)]
    band_per_mm: Vec<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

impl PsdArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let surface = self.map.read(&mut inputs)?;
        let settings = PsdSettings {
            window: self.window,
            detrend: self.detrend,
            band_per_mm: self.band_per_mm.chunks_exact(2).map(|b| [b[0], b[1]]).collect(),
        };
        let task = task!("psd", &settings);
        let mut output = match Output::directory(&self.output, &kind::PSD).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let psd = psd(&surface, &settings).map_err(Failure::with_flags)?;
        let picture = [("psd.svg", psd_svg(&psd).into_bytes())];
        let outcome = serde_json::to_value(&psd.report)?;
        output.write_arrays(&kind::PSD, &psd_arrays(&psd), &picture, outcome, &Status::Done)?;
        let r = &psd.report;
        say(format!(
            "planish surface: spectrum of {} x {} px ({:.1} % of the valid ones), RMS {:.4} nm, in the \
             spectrum {:.4} nm",
            r.shape.1,
            r.shape.0,
            100.0 * r.fraction_of_valid_pixels,
            r.rms_nm,
            r.spectral_rms_nm
        ));
        for b in &r.bands {
            let [low, high] = b.band_per_mm;
            say(format!(
                "planish surface: {low} .. {high} /mm: {:.4} nm RMS (along x {:.4}, along y {:.4})",
                b.rms_nm, b.rms_x_nm, b.rms_y_nm
            ));
        }
        Ok(Status::Done)
    }
}

/// Returns the arrays of the artifact `psd`, in the order of its kind.
fn psd_arrays(psd: &Psd) -> Vec<ArrayData<'_>> {
    let line = |v: &[f64]| ArrayData::F64(Array1::from(v.to_vec()).into_dyn().into());
    vec![
        ArrayData::F64(psd.psd_2d_nm2_mm2.view().into_dyn().into()),
        line(&psd.frequency_2d_x_per_mm),
        line(&psd.frequency_2d_y_per_mm),
        line(&psd.psd_x_nm2_mm),
        line(&psd.frequency_x_per_mm),
        line(&psd.psd_y_nm2_mm),
        line(&psd.frequency_y_per_mm),
        line(&psd.psd_radial_nm2_mm2),
        line(&psd.frequency_radial_per_mm),
    ]
}
