//! The rack of a run with several tools: reading it, and what is refused or doubted before anything is written.

use std::path::Path;

use planish_handoff::{Failure, Inputs, warn};
use planish_types::{
    Kinematics, Rack, RackEntry, Surface, Tif, ToolPath, check_rates, doubts, reach::Reach,
};

/// Part of a map, in RMS, from which a warning says that no tool of the rack reaches its waves. Larger: a rack without a
/// narrow tool passes until it is planned. Smaller: warnings about the noise of a map.
const SHORT_PART: f64 = 0.05;

/// A rack with what the files of its tools hold.
pub struct CheckedRack {
    /// The rack, with absolute paths.
    pub rack: Rack,
    /// TIF of each tool.
    tifs: Vec<Tif>,
}

impl CheckedRack {
    /// Reads the rack and makes its paths absolute.
    ///
    /// # Errors
    /// Refuses a file that cannot be read, a tool that has neither a tool path nor a pitch, a machine with other axes than
    /// x and y, and rates that differ by more than 1e6.
    pub fn read(path: &str) -> Result<Self, Failure> {
        let path = Path::new(path);
        let rack: Rack = Inputs::new().read_json("rack", path)?;
        let of_rack = |problem: String| Failure::new(format!("{}: {problem}", path.display()));
        rack.check().map_err(of_rack)?;
        let directory = std::path::absolute(path.parent().unwrap_or(Path::new("")).join("."))?;
        let mut tools = rack.tools;
        for tool in &mut tools {
            if tool.tool_path.is_none() && tool.pitch_mm.is_none() {
                return Err(of_rack(format!(
                    "tool {:?} has neither tool_path nor pitch_mm; give pitch_mm, the distance of its lines",
                    tool.name
                )));
            }
            tool.tif = directory.join(&tool.tif);
            tool.tool_path = tool.tool_path.as_ref().map(|own| directory.join(own));
            tool.machine = tool.machine.as_ref().map(|own| directory.join(own));
        }
        Self::of_entries(tools, &path.display().to_string())
    }

    /// Reads the files of tools with absolute paths. `from` names the file that lists them.
    ///
    /// # Errors
    /// Refuses a file that cannot be read, a machine with other axes than x and y, and rates that differ by more than
    /// 1e6.
    pub fn of_entries(tools: Vec<RackEntry>, from: &str) -> Result<Self, Failure> {
        let mut tifs = Vec::with_capacity(tools.len());
        for tool in &tools {
            let mut inputs = Inputs::new();
            let tif = inputs.read_tool("tif", &tool.tif)?;
            tif.same_at_all_times("a plan of several tools")
                .map_err(|problem| Failure::new(format!("tool {:?}: {problem}", tool.name)))?;
            tifs.push(tif);
            if let Some(path) = &tool.tool_path {
                inputs.read::<ToolPath>("tool-path", path)?;
            }
            if let Some(machine) = &tool.machine {
                refuse_other_axes(machine)?;
            }
        }
        let named: Vec<(&str, &Tif)> =
            tools.iter().map(|tool| tool.name.as_str()).zip(&tifs).collect();
        check_rates(&named).map_err(|problem| Failure::new(format!("{from}: {problem}")))?;
        Ok(Self { rack: Rack { tools }, tifs })
    }

    /// Warns of tools that are wider than the part, and of waves that no tool reaches.
    pub fn warn(&self, surface: &Surface) {
        for (tool, tif) in self.rack.tools.iter().zip(&self.tifs) {
            if let Some(doubt) = doubts::of_width(surface, tif) {
                warn(format!("tool {:?}: {doubt}", tool.name));
            }
        }
        let tifs: Vec<&Tif> = self.tifs.iter().collect();
        let Some(reach) = Reach::new(surface, &tifs) else { return };
        let short_nm = reach.short_wave_rms_nm(surface);
        if let Some(longest_mm) = reach.longest_mm()
            && short_nm > SHORT_PART * surface.detilted_rms_nm()
        {
            warn(format!(
                "waves shorter than {longest_mm:.2} mm remain, {short_nm:.4} nm RMS of the map: no tool of the rack \
                 reaches them; add a narrower tool if they matter"
            ));
        }
    }
}

/// Refuses a machine with more axes than x and y.
///
/// # Errors
/// Fails if the file cannot be read.
pub fn refuse_other_axes(machine: &Path) -> Result<(), Failure> {
    match Inputs::new().read_machine(machine)?.kinematics() {
        Kinematics::Xy => Ok(()),
        _ => Err(Failure::new(format!(
            "{}: several tools are planned for machines with the axes x and y, and this one has more; plan each tool \
             with planish run raster",
            machine.display()
        ))),
    }
}
