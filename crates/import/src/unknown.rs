//! Description of a file of no known format, and the remedy.

use crate::text;

/// First bytes of formats that are not read, with their name and what helps.
const OTHERS: [(&[u8], &str, &str); 11] = [
    (b"CDF\x01", "a netCDF classic file", "convert it: nccopy -k nc4 IN OUT.h5"),
    (b"CDF\x02", "a netCDF classic file", "convert it: nccopy -k nc4 IN OUT.h5"),
    (b"\x0e\x03\x13\x01", "an HDF4 file", "convert it: h4toh5 IN OUT"),
    (b"\x1f\x8b", "compressed by gzip", "unpack it first: gunzip"),
    (b"\x89PNG", "a PNG picture", "export the heights, not the picture"),
    (b"\xff\xd8\xff", "a JPEG picture", "export the heights, not the picture"),
    (b"II*\0", "a TIFF picture", "export the heights as numbers, such as .csv or .npy"),
    (b"MM\0*", "a TIFF picture", "export the heights as numbers, such as .csv or .npy"),
    (b"%PDF", "a PDF document", "export the heights, not the report"),
    (b"\xd0\xcf\x11\xe0", "a document of Office or LabVIEW", "export the table as .csv"),
    (b"Wyko ASCII", "an ASCII export of Wyko", "export it as .opd"),
];

/// The problem and the remedy for a file that starts with `bytes`; `formats` are the names that `format` takes.
pub fn unknown(bytes: &[u8], formats: &[String]) -> String {
    let (looks, remedy) = looks(bytes);
    format!(
        "is of no format that is known: it looks like {looks}; {remedy}. Formats: {}",
        formats.join(", ")
    )
}

fn looks(bytes: &[u8]) -> (String, String) {
    let known = |k: &&(&[u8], &str, &str)| bytes.starts_with(k.0);
    if let Some((_, name, remedy)) = OTHERS.iter().find(known) {
        return ((*name).into(), (*remedy).into());
    }
    if let Ok(text) = text::text("text", bytes) {
        let line = text.lines().find(|l| !l.trim().is_empty() && !l.trim_start().starts_with('#'));
        let line = line.unwrap_or_default();
        let fields: Vec<&str> = text::fields(line).take(1000).collect();
        let are_numbers = fields.iter().all(|f| f.parse::<f64>().is_ok());
        let short: String = line.chars().filter(|c| !c.is_control()).take(40).collect();
        return match (are_numbers, fields.len()) {
            (true, 3) => (
                "text with lines of 3 numbers".into(),
                "give `format` xyz for lines x y z, or csv for a matrix of 3 columns".into(),
            ),
            (true, n) if n > 1 => (
                format!("text with {n} numbers in its first line"),
                "give `format` csv for a matrix, with `unit` and `pixel_mm`".into(),
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
