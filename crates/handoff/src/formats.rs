//! Generator of `docs/formats.md`, the page that describes the files of Planish.

use planish_types::ControllerKind;

use crate::kind::ALL;

/// Largest width of a paragraph of the page, characters. Larger: lines exceed the 120 characters that a test allows.
/// Smaller: more lines.
const PARAGRAPH_COLUMNS: usize = 110;

/// Wraps a paragraph into lines of at most [`PARAGRAPH_COLUMNS`] characters.
fn wrapped(text: &str) -> String {
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        let line = lines.last_mut().expect("there is a line from the start");
        if line.is_empty() {
            *line = word.into();
        } else if line.len() + 1 + word.len() <= PARAGRAPH_COLUMNS {
            *line += &format!(" {word}");
        } else {
            lines.push(word.into());
        }
    }
    lines.join("\n")
}

/// Returns the text of `docs/formats.md`.
pub fn formats_markdown() -> String {
    let mut page = String::from(FORMATS_INTRODUCTION);
    for kind in ALL {
        let doc = wrapped(kind.doc);
        page += &format!("\n## `{}` (version {})\n\n{doc}\n\n", kind.name, kind.version);
        page += &format!("Frame: {}.\n", kind.frame);
        if !kind.arrays.is_empty() {
            page += "\n| file | dtype | shape | axes | unit | what |\n|---|---|---|---|---|---|\n";
        }
        for a in kind.arrays {
            let mut doc = a.doc.to_string();
            if a.nan_allowed {
                doc += " NaN allowed.";
            }
            if let (Some(v), Some(since)) = (a.default, a.optional_since) {
                doc += &format!(
                    " Taken as {v} where it is absent: an artifact without it has version {}.",
                    since - 1
                );
            } else if let Some(since) = a.optional_since {
                doc +=
                    &format!(" May be absent: an artifact without it has version {}.", since - 1);
            } else if let Some(v) = a.default {
                doc += &format!(" Taken as {v} where a directory without a manifest lacks it.");
            }
            page += &format!(
                "| `{}.npy` | `{}` | ({}) | {} | {} | {} |\n",
                a.name,
                a.dtype.numpy().replace('|', "\\|"),
                a.shape.join(", "),
                a.axes.join(", ").replace('|', "\\|"),
                a.unit,
                doc
            );
        }
        for file in kind.files {
            page += &format!("\nBeside the manifest: `{file}`.\n");
        }
    }
    page += MACHINE_FILE;
    let kinds = ControllerKind::ALL.map(|kind| format!("`{}`", kind.name())).join(", ");
    for (key, unit, doc) in MACHINE_KEYS {
        let doc = doc.replace("KINDS", &kinds);
        page += &format!("| `{key}` | {unit} | {doc} |\n");
    }
    page += MACHINE_COORDINATES;
    page += FORM_FILE;
    page += ERROR_BUDGET;
    for (key, unit, doc) in PROCESS_KEYS {
        page += &format!("| `{key}` | {unit} | {doc} |\n");
    }
    page
}

/// Keys of a machine file: (key, unit, description). Keys of an axis stand under `axes`.
const MACHINE_KEYS: [(&str, &str, &str); 38] = [
    ("name", "-", "Name of the machine."),
    (
        "axes",
        "-",
        "Objects with the keys below for the linear axes: x, then y. Other `kinematics` have other axes \
         ([table](axes.md#the-kinematics)).",
    ),
    ("axes[].name", "-", "`x` or `y`; `z` or `r` where the kinematics have them."),
    ("axes[].max_velocity_mm_per_s", "mm/s", "Largest velocity; > 0."),
    ("axes[].max_acceleration_mm_per_s2", "mm/s^2", "Largest acceleration; > 0."),
    (
        "axes[].max_jerk_mm_per_s3",
        "mm/s^3",
        "Largest jerk; > 0; when left out, `time_to_full_acceleration_s` decides.",
    ),
    (
        "axes[].travel_mm",
        "mm",
        "Smallest and largest position that the axis reads; left out where nobody limits it.",
    ),
    (
        "axes[].along",
        "-",
        "`+x`, `-x`, `+y` or `-y`: where the tool goes over the turned part when the axis counts up. Left out: the \
         axis x along `+x`, y along `+y`.",
    ),
    (
        "rotary_axes",
        "-",
        "Objects with the keys below for the rotary axes of the kinematics: `a` and `b`, or `c` (and `b`). Left out: \
         none.",
    ),
    ("rotary_axes[].name", "-", "`a`, `b` or `c`."),
    ("rotary_axes[].max_velocity_deg_per_s", "deg/s", "Largest velocity; > 0."),
    ("rotary_axes[].max_acceleration_deg_per_s2", "deg/s^2", "Largest acceleration; > 0."),
    (
        "rotary_axes[].max_jerk_deg_per_s3",
        "deg/s^3",
        "Largest jerk; > 0; when left out, `time_to_full_acceleration_s` decides.",
    ),
    (
        "rotary_axes[].travel_deg",
        "degrees",
        "Smallest and largest position that the axis reads; left out where nobody limits it.",
    ),
    (
        "kinematics.kind",
        "-",
        "`xy`, `xyz`, `xyz-tilts` or `spindle` ([axes](axes.md)); `xy` when `kinematics` is left out.",
    ),
    (
        "kinematics.pivot_mm",
        "mm",
        "Distance from the contact point to the pivot of the tilts, along the tool; negative below the surface. Of \
         `xyz-tilts`, and of a `spindle` with the axis b.",
    ),
    (
        "kinematics.tilts",
        "-",
        "`[\"a\", \"b\"]` or `[\"b\", \"a\"]`: the first tilt carries the second; of `xyz-tilts`.",
    ),
    (
        "kinematics.contact",
        "-",
        "Object with `max_velocity_mm_per_s`, `max_acceleration_mm_per_s2` and, if any, `max_jerk_mm_per_s3`: limits of \
         the contact point along x and y of the part, which plans keep; of `spindle`.",
    ),
    (
        "time_to_full_acceleration_s",
        "s",
        "Time from rest to the full acceleration: the jerk limit of an axis without `max_jerk_mm_per_s3` is its \
         acceleration limit over this time. 0: no limit on jerk. Left out: no limit on jerk either, but a pipeline \
         (`just run`) warns and takes 0.1 s.",
    ),
    (
        "min_segment_s",
        "s",
        "Shortest segment that the controller accepts; 0 when left out: any length.",
    ),
    (
        "part_rotation_deg",
        "degrees",
        "Angle by which the part is turned from x towards y; 0 when left out.",
    ),
    (
        "part_origin_mm",
        "mm",
        "What the axes [x, y] read where the tool is over the origin of the part; [0, 0] when left out.",
    ),
    (
        "part_origin_z_mm",
        "mm",
        "What the axis z reads where the tool, without tilt, touches the height 0 of the part; 0 when left out.",
    ),
    (
        "controller",
        "-",
        "Object with the keys below: the grids of the programs for this machine. Left out, or a key left out: the \
         defaults of the kind ([table](controllers.md#the-controller)).",
    ),
    ("controller.kind", "-", "One of KINDS."),
    ("controller.tick_s", "s", "Clock: times of nodes are multiples of it."),
    (
        "controller.count_mm",
        "mm",
        "Counts of the linear axes, one for each: positions of nodes are multiples of it.",
    ),
    ("controller.count_deg", "degrees", "Counts of the rotary axes, one for each."),
    ("controller.velocity_mm_per_s", "mm/s", "Resolution of a velocity of the linear axes."),
    ("controller.velocity_deg_per_s", "deg/s", "Resolution of a velocity of the rotary axes."),
    ("controller.min_segment_s", "s", "Shortest segment of a program."),
    (
        "controller.max_segments",
        "-",
        "Largest number of segments of a program; any number when left out.",
    ),
    (
        "controller.interpolation",
        "-",
        "`hermite` (cubic through positions and velocities) or `linear` (`gcode`, `sinumerik`, `xps-pt`): a check, no choice.",
    ),
    (
        "controller.switches_tool",
        "-",
        "`false` if no output of the controller is wired to the tool.",
    ),
    (
        "controller.prologue",
        "-",
        "Lines of the controller's language before the motion, which move nothing ([list](controller-runs.md#lines-of-the-machine)).",
    ),
    ("controller.epilogue", "-", "Lines after the motion."),
    (
        "controller.tool_on",
        "-",
        "Lines by which the host of a Galil or an XPS switches the tool on.",
    ),
    ("controller.tool_off", "-", "Lines by which it switches the tool off."),
];

const MACHINE_FILE: &str = "
## Machine file

The limits of a machine, given by `--machine`: one JSON object, see `fixtures/machines/`. A limit bounds the magnitude
on its own axis. Planish refuses a key that is not in the table.

| key | unit | what |
|---|---|---|
";

const MACHINE_COORDINATES: &str = "
If `part_rotation_deg`, `part_origin_mm` and `along` are left out, the axes read the coordinates of the part. Otherwise
the axis i reads q_i = s_i (R p)_j(i) + o_i over the point p of the part. R turns by `part_rotation_deg`, s and j are
the sign and the direction of `along`, and o is `part_origin_mm`. An axis that carries the part moves the tool the other
way: give the opposite sign.

Plans stay in the coordinates of the part, within the largest box of limits there that the axes can follow in every
direction. `planish verify` judges the motion of the axes, and `planish export` writes it. If fiducials say how the part
lies ([from run to run](campaign.md)), `planish register apply` takes the motion to the axes. These keys are then not
applied again.

On a machine with other kinematics than `xy` that box is of x and y alone, or of `kinematics.contact`. `planish axes`
makes the motion of all axes ([axes](axes.md)), `planish verify --axes` judges it, and `planish export --axes` writes
its program. `planish export --trajectory` refuses such a machine.
";

/// Keys of an error budget: (key, unit, description).
const PROCESS_KEYS: [(&str, &str, &str); 11] = [
    ("name", "-", "Name of the process."),
    ("errors", "-", "At least one object with the keys below."),
    ("errors[].kind", "-", "What goes wrong: one of the kinds in `docs/tolerance.md`."),
    (
        "errors[].size",
        "`unit`",
        "Standard deviation of a `normal` error, half the width of a `uniform` one, the value of a `fixed` one.",
    ),
    (
        "errors[].unit",
        "-",
        "`%` or `1`; `mm` or `um`; `deg`, `mrad` or `rad`; `s`, `ms` or `us`; `nm`: as the kind asks.",
    ),
    ("errors[].distribution", "-", "`normal`, `uniform` or `fixed`."),
    ("errors[].note", "-", "Where the figure comes from."),
    ("errors[].correlation_s", "s", "Correlation time; of `rate_noise` only."),
    ("errors[].time_constant_s", "s", "Time constant; of `rate_warm_up` only."),
    ("errors[].damping_ratio", "1", "Damping ratio, 0.005 to 2; of `servo_second_order` only."),
    ("errors[].degree", "1", "Largest total degree, 1 to 8; of `map_low_order` only."),
];

const FORM_FILE: &str = "
## Form file

The form of a part, given by `--form` or `--target`: one JSON object. Its kinds and keys are in
[the form of a part](forms.md#the-form-file). Planish refuses a key that the kind does not use.
`planish surface prepare --target` writes one as `form.json` beside its map.
";

const ERROR_BUDGET: &str = "
## Error budget

The errors of a process, given by `--error-budget`: one JSON object, see `fixtures/error-budgets/`. Planish refuses a
key that is not in the table, and one that the kind of the error does not use.

| key | unit | what |
|---|---|---|
";

const FORMATS_INTRODUCTION: &str = "\
# Formats

<!-- Generated by `just docs` from crates/handoff/src/kind.rs and formats.rs; do not edit. -->

This page lists every file that Planish reads and writes. Read it before you write an input or read a result by a
script. Every stage reads and writes directories. A directory holds `manifest.json` and one `.npy` file per array
(little-endian, C order, `numpy.load` reads it). Units are in the names.

Planish also reads a directory without `manifest.json`, with a warning. To make an artifact of your own, `numpy.save`
the arrays below under their names.

`manifest.json`:

| key | what |
|---|---|
| `kind`, `version` | which of the kinds below, and the version of its layout |
| `tool`, `tool_version`, `method` | what wrote it |
| `command` | the command line |
| `key` | BLAKE3 of tool, version, method, settings and inputs: an unchanged stage does nothing |
| `frame` | what the coordinates refer to |
| `settings` | every setting, with the defaults that were used, and the seed where there is one |
| `inputs` | role, path, kind and BLAKE3 of every input |
| `lineage` | kind (of a file: role) and BLAKE3 of everything that it was made from, inputs of inputs included |
| `outcome` | `status` (`done`, or `negative` with the reason) and what the method reports |
| `arrays` | per array: file, dtype, shape, axes, unit, BLAKE3 of the file |
| `files` | BLAKE3 of the files beside the arrays, where there are any |
| `seal` | the last key: BLAKE3 of the text of the manifest before it |

A reader checks kind, version, dtype, shape, finiteness, axes, hashes and seal. It converts arrays of another element
type (integers, booleans, 32-bit floats) or byte order, or in Fortran order, if every value stays exactly the same, and
says so. It refuses complex numbers, half and extended precision, and a value that would change.

Two inputs of a stage can contradict each other, if one was made from another artifact than the one beside it. The stage
refuses them (dwell times along another path), or warns where that can make sense (a plan simulated on another map).

A stage replaces only what Planish wrote and nobody changed. It refuses a directory without a manifest, or with a file
that the manifest does not know, even with `--force`. All artifacts of a run appear together and whole. They are on the
disk when the run ends with 0 or 1.

No file holds the time of day, so the same command on the same input gives the same bytes. A report states how long the
stages took, but these times are part of its input.
";
