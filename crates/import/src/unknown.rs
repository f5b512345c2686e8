//! Message for a file of an unknown format: its likely type, and the remedy.

use crate::text;

/// First bytes of file formats that are not read, each with a name for the message and a remedy.
const OTHERS: [(&[u8], &str, &str); 24] = [
    (b"CDF\x01", "a netCDF classic file", "convert it: nccopy -k nc4 IN OUT.h5"),
    (b"CDF\x02", "a netCDF classic file", "convert it: nccopy -k nc4 IN OUT.h5"),
    (b"CDF\x05", "a netCDF classic file", "convert it: nccopy -k nc4 IN OUT.h5"),
    (b"\x0e\x03\x13\x01", "an HDF4 file", "convert it: h4toh5 IN OUT"),
    (b"\x1f\x8b", "compressed by gzip", "unpack it first: gunzip"),
    (b"\x89PNG", "a PNG picture", "export the heights, not the picture"),
    (b"\xff\xd8\xff", "a JPEG picture", "export the heights, not the picture"),
    (b"II*\0", "a TIFF picture", "export the heights as numbers, such as .csv or .npy"),
    (b"MM\0*", "a TIFF picture", "export the heights as numbers, such as .csv or .npy"),
    (b"II+\0", "a TIFF picture", "export the heights as numbers, such as .csv or .npy"),
    (b"MM\0+", "a TIFF picture", "export the heights as numbers, such as .csv or .npy"),
    (b"%PDF", "a PDF document", "export the heights, not the report"),
    (b"\xd0\xcf\x11\xe0", "a document of Office or LabVIEW", "export the table as .csv"),
    (
        b"PK\x03\x04",
        "a ZIP archive such as .xlsx or .plux",
        "export the sheet as .csv, the map as .x3p or .sur",
    ),
    (b"AliconaImaging", "a map of Alicona (.al3d)", "export it as .sdf, .x3p or .sur"),
    (b"Binary TrueMap", "a map of TrueMap (.tmd)", "export it as .sdf, .x3p or .sur"),
    (
        b"VK4_",
        "a map of Keyence",
        "export it as .csv, without the lines above the numbers, or as .sdf",
    ),
    (
        b"DSAA",
        "a grid of Surfer",
        "delete the 5 lines above the numbers, and give `format` csv, `unit` and `pixel_mm`",
    ),
    (b"DSBB", "a grid of Surfer", "save it as text"),
    (
        b"ncols",
        "an ESRI grid",
        "start the lines above the numbers with #, and give `format` csv, `unit`, `pixel_mm`, `no_data` and `first_row` top",
    ),
    (b"ply\n", "a PLY file of points", "delete the lines up to end_header, and give `format` xyz"),
    (b"{", "JSON", "save the array as .csv or .npy"),
    (b"<?xml", "XML", "export the heights as numbers, such as .csv or .npy"),
    (b"Wyko ASCII", "an ASCII export of Wyko", "export it as .opd"),
];

/// Returns the message for a file that starts with `bytes` and has an unknown format. `formats` are the names of those
/// that are read.
pub fn unknown(bytes: &[u8], formats: &[String]) -> String {
    let (looks, remedy) = looks(bytes);
    format!(
        "is of no format that is known: it looks like {looks}; {remedy}. Formats: {}",
        formats.join(", ")
    )
}

/// Returns the likely type of a file, from its first bytes or the first line of its text, and the remedy.
fn looks(bytes: &[u8]) -> (String, String) {
    if let Some((_, name, remedy)) = OTHERS.iter().find(|other| bytes.starts_with(other.0)) {
        return ((*name).into(), (*remedy).into());
    }
    // Types of MATLAB 4: 1000 x byte order + 10 x number + kind, then rows, columns and a flag for complex numbers.
    let words: Vec<u32> = bytes
        .chunks_exact(4)
        .take(5)
        .map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect();
    if let [kind, 1..=0xFFFFFF, 1..=0xFFFFFF, 0 | 1, 1..=64] = words[..]
        && kind <= 52
        && kind % 10 <= 2
    {
        return ("a MATLAB 4 file".into(), "save it with -v7".into());
    }
    if let Ok(text) = text::text("text", bytes) {
        let text = text.as_ref();
        let line = text.lines().find(|l| !l.trim().is_empty() && !l.trim_start().starts_with('#'));
        let line = line.unwrap_or_default();
        let fields: Vec<&str> = text::fields(line).take(1000).collect();
        let are_numbers = fields.iter().all(|f| f.parse::<f64>().is_ok());
        let short: String = line.chars().filter(|c| !c.is_control()).take(40).collect();
        return match (are_numbers, fields.len()) {
            (true, 3) => (
                "text with lines of 3 numbers".into(),
                "give `format` xyz for lines x y z; save a matrix of 3 columns as .npy".into(),
            ),
            (true, 2) => (
                "text with lines of 2 numbers".into(),
                "planish surface line reads a profile; save a matrix of 2 columns as .npy".into(),
            ),
            (true, n) if n > 1 => (
                format!("text with {n} numbers in its first line"),
                "give `format` csv for a matrix, with `unit` and `pixel_mm` where the file does not state them".into(),
            ),
            _ => (
                format!("text that begins \"{short}\""),
                "give `format` csv or xyz for text of numbers, and start lines of words with #"
                    .into(),
            ),
        };
    }
    let hex: Vec<String> = bytes.iter().take(8).map(|b| format!("{b:02X}")).collect();
    let looks = format!("binary data that begins {}", hex.join(" "));
    (looks, "export it in one of the formats, or as .npy".into())
}
