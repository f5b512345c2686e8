//! The report page: one HTML file with its data, its style and its JavaScript program.

use planish_draw::{
    colour::{BLUE_TO_BROWN, VIRIDIS_FOR_LINES},
    page,
};
use planish_types::{
    Grid,
    outcome::verdict::{Check, Verdict},
    text::escaped,
};
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use super::{
    motion::{Dwell, QUANTITIES, Ranges},
    pack::{Rounding, base64, doubles, floats, pack, pack_between},
    spectrum::BAND_PERIOD_MM,
    view::{FrameView, MAX_MAP_PIXELS, MethodView, View},
};
use crate::{
    answer::with_answer,
    front::{self, FrontPoint},
    made::Made,
};

/// Skeleton of the page, and the CSS rules that it has beside the shared ones.
const HTML: &str = include_str!("page.html");
const CSS: &str = include_str!("page.css");
/// JavaScript program of the page, one subject per file; a file uses the constants of those before it.
const JS: &str = concat!(
    include_str!("page/data.js"),
    include_str!("page/runs.js"),
    include_str!("page/colours.js"),
    include_str!("page/canvas.js"),
    include_str!("page/answer.js"),
    include_str!("page/panel.js"),
    include_str!("page/map.js"),
    include_str!("page/first_screen.js"),
    include_str!("page/slopes.js"),
    include_str!("page/path.js"),
    include_str!("page/dwell.js"),
    include_str!("page/chart.js"),
    include_str!("page/profiles.js"),
    include_str!("page/motion.js"),
    include_str!("page/heights.js"),
    include_str!("page/front.js"),
    include_str!("page/rounds.js"),
    include_str!("page/error_budget.js"),
    include_str!("page/tables.js"),
    include_str!("page/places.js"),
    include_str!("page/low_order.js"),
    include_str!("page/several.js"),
    include_str!("page/provenance.js"),
    include_str!("page/full_values.js"),
    include_str!("page/start.js"),
);

/// Returns the report page as one HTML file. `summaries` is the content of `summary.json`, `points` are the plans with
/// time and residual. The same views give the same bytes.
pub fn page(views: &[View], summaries: &Value, points: &[FrontPoint]) -> String {
    let names: Vec<String> = match views {
        [one] => one.summary.part_and_pipeline(&one.name),
        several => several.iter().map(|v| v.name.clone()).collect(),
    };
    let data = json!({
        "summary": summaries,
        "runs": views.iter().map(run_json).collect::<Vec<_>>(),
        "front": {
            "points": points,
            "on_the_front": front::front(points),
            "csv": front::csv(points),
        },
        "band_period_mm": BAND_PERIOD_MM,
        "colours": { "height": BLUE_TO_BROWN, "speed": VIRIDIS_FOR_LINES },
    });
    let title = names.join(", ");
    let body = filled(
        HTML,
        &[
            ("title", &escaped(&title)),
            ("tool", &(tools(views) + &axes(views))),
            ("js", JS),
            ("data", &in_script(&data)),
        ],
    );
    let style = page::style(CSS);
    page::document(&title, &policy(&style), &style, &body)
}

/// Returns the HTML section with the tools; empty if none is known.
fn tools(views: &[View]) -> String {
    let mut figures = String::new();
    for picture in views.iter().flat_map(|view| &view.tool) {
        let class = if picture.varies { "drawing wide" } else { "drawing" };
        figures += &format!("<figure class=\"{class}\">{}</figure>\n", picture.svg);
    }
    if figures.is_empty() {
        return figures;
    }
    let varies = views.iter().flat_map(|view| &view.tool).any(|picture| picture.varies);
    let note = if varies {
        "The tool is not the same everywhere. Left: the volume that it removes per second at a place of the part, over \
         its mean. Right: its footprint at the nine numbered places, without factors of pixels and time."
    } else {
        "Removal rate at the offset of a pixel from the tool, and its sections along x and y through the peak, with \
         their widths at half of the peak (FWHM)."
    };
    format!(
        "<section id=\"tool\"><h2>Tool</h2>\n<p class=\"note\">{note}</p>\n<div class=\"panels\">{figures}</div>\n</section>\n"
    )
}

/// Returns the HTML section with the motions of all axes of a machine; empty if no run has one.
fn axes(views: &[View]) -> String {
    let mut parts = String::new();
    for view in views {
        for m in &view.methods {
            let result = view.summary.methods.iter().find(|(name, _)| *name == m.name);
            let on_axes = result.and_then(|(_, result)| result.on_axes.as_ref());
            if let (Some(picture), Some(on_axes)) = (&m.on_axes, on_axes) {
                parts += &format!(
                    "<p>{}</p>\n<div class=\"scroll\">{picture}</div>\n",
                    escaped(&on_axes.sentence(&m.name))
                );
            }
        }
    }
    if parts.is_empty() {
        return parts;
    }
    format!(
        "<section id=\"axes\"><h2>All axes of the machine</h2>\n<p class=\"note\">Position, velocity, acceleration and \
         jerk of every axis over the time. Dashed: a limit, where the motion comes near it. A limit far away is named \
         above the panel.</p>\n{parts}</section>\n"
    )
}

/// Returns the content security policy of the page. The browser then runs only the program and the style of this
/// page, known by their hashes, whatever the names and manifests of a run contain.
fn policy(style: &str) -> String {
    let [style, script] =
        [style, JS].map(|text| format!("'sha256-{}'", base64(&Sha256::digest(text.as_bytes()))));
    format!(
        "default-src 'none'; base-uri 'none'; form-action 'none'; img-src data: blob:; \
         style-src {style}; script-src {script}"
    )
}

/// Returns JSON that is safe in an HTML script element: nothing in it can end the element or open a comment.
fn in_script(data: &Value) -> String {
    let text = data.to_string();
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => out += &format!("\\u{:04x}", c as u32),
            c => out.push(c),
        }
    }
    out
}

/// Returns `template` with every `{{key}}` replaced by its value; keys within values are not replaced.
fn filled(template: &str, values: &[(&str, &str)]) -> String {
    let mut out = String::new();
    let mut rest = template;
    while let Some((before, after)) = rest.split_once("{{") {
        let (key, after) = after.split_once("}}").expect("a key of the template ends");
        let value = values.iter().find(|(k, _)| *k == key).expect("every key has its value").1;
        out += before;
        out += value;
        rest = after;
    }
    out + rest
}

fn run_json(view: &View) -> Value {
    json!({
        "name": view.name,
        "pipeline": view.summary.pipeline,
        "fixture": view.summary.fixture,
        "best": view.summary.best,
        "summary": with_answer(&view.summary),
        "desired": view.desired,
        "measured": view.measured,
        "error_budget": view.summary.error_budget.as_ref().map(|p| p.for_page(MAX_MAP_PIXELS)),
        "histogram": view.before.0,
        "spectrum": view.before.1,
        "methods": view.methods.iter().map(method_json).collect::<Vec<_>>(),
        "provenance": provenance_json(&view.provenance),
    })
}

fn method_json(m: &MethodView) -> Value {
    json!({
        "name": m.name,
        "removal": m.removal,
        "residual": m.residual,
        "histogram": m.after.0,
        "spectrum": m.after.1,
        "line": {
            "every": m.line.every,
            "x_mm": pack(m.line.point_mm.iter().map(|p| p[0])),
            "y_mm": pack(m.line.point_mm.iter().map(|p| p[1])),
            "time_s": doubles(m.line.time_s.iter().copied()),
            "speed_mm_per_s": floats(m.line.speed_mm_per_s.iter().copied()),
        },
        "ranges": ranges_json(&m.ranges),
        "limits": limits_json(&m.verdict),
        "violations": m.verdict.violations,
        "dwell": m.dwell.as_ref().map(dwell_json),
        "frames": m.frames.as_ref().map(frames_json),
        "rounds": m.rounds.as_ref().map(|r| json!({
            "rms_nm": r.rms_nm, "total_time_s": r.total_time_s, "best": r.best,
        })),
        "provenance": provenance_json(&m.provenance),
    })
}

fn ranges_json(ranges: &Ranges) -> Value {
    let mut json = json!({
        "every": ranges.every,
        "end_s": doubles(ranges.end_s.iter().copied()),
    });
    for (envelopes, name) in ranges.envelope.iter().zip(QUANTITIES) {
        json[name] = envelopes
            .iter()
            .map(|e| {
                let low = e.low.iter().copied().fold(f64::INFINITY, f64::min);
                let high = e.high.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                json!({
                    "low": pack_between(e.low.iter().copied(), low, high, Rounding::Down),
                    "high": pack_between(e.high.iter().copied(), low, high, Rounding::Up),
                })
            })
            .collect();
    }
    json
}

/// Returns, for each quantity and axis, the limit, the number of times it is exceeded, and the worst points. It also
/// returns the times of the worst steps in position and velocity, which no machine can execute.
fn limits_json(verdict: &Verdict) -> Value {
    let mut json = Map::new();
    for (order, name) in QUANTITIES.into_iter().enumerate() {
        let of_axis = verdict.axes.each_ref().map(|axis| check_json(axis.derivatives()[order]));
        json.insert(name.into(), json!(of_axis));
    }
    let steps = verdict.axes.iter().flat_map(|a| [&a.position_step_mm, &a.velocity_step_mm_per_s]);
    let times = steps.flat_map(|check| &check.worst).map(|place| place.time_s);
    json.insert("steps".into(), times.collect());
    json.into()
}

fn check_json(check: &Check) -> Value {
    json!({
        "limit": check.limit.filter(|limit| *limit >= 0.0),
        "exceeding_count": check.exceeding_count,
        "worst": check.worst.iter().map(|place| [place.time_s, place.value]).collect::<Vec<_>>(),
    })
}

fn dwell_json(d: &Dwell) -> Value {
    json!({
        "every": d.every,
        "x_mm": pack(d.point_mm.iter().map(|p| p[0])),
        "y_mm": pack(d.point_mm.iter().map(|p| p[1])),
        "planned_s": floats(d.planned_s.iter().copied()),
        "executed_s": d.executed_s.as_ref().map(|s| floats(s.iter().copied())),
        "total_error_s": d.total_error_s,
    })
}

fn frames_json(f: &FrameView) -> Value {
    let Grid { x, y } = &f.grid;
    json!({
        "time_s": f.time_s,
        "start_mm": [x.start_mm(), y.start_mm()],
        "step_mm": [x.step_mm(), y.step_mm()],
        "size": [x.len(), y.len()],
        "residual_nm": pack(f.residual_nm.iter().copied()),
    })
}

/// Returns the manifests of the artifacts for the page; they do not contain the arrays.
fn provenance_json(manifests: &[Made]) -> Value {
    manifests.iter().map(|made| json!(made.shown)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_template_is_filled_in_one_pass() {
        let values = [("a", "{{b}}<"), ("b", "{{a}}")];
        assert_eq!(filled("1{{a}}2{{b}}3{{a}}", &values), "1{{b}}<2{{a}}3{{b}}<");
        assert_eq!(filled("none", &values), "none");
    }

    #[test]
    fn every_file_of_the_program_is_in_the_page() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src/report/page");
        let mut length = 0;
        for entry in std::fs::read_dir(folder).unwrap() {
            let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
            assert_eq!(JS.matches(text.as_str()).count(), 1, "{text:.80}");
            length += text.len();
        }
        assert_eq!(length, JS.len());
    }

    #[test]
    fn nothing_in_the_data_ends_its_element() {
        let data = json!({ "</script><!--": "<img>&\u{2028}\u{2029}" });
        let text = in_script(&data);
        assert!(!text.contains(['<', '>', '&', '\u{2028}', '\u{2029}']), "{text}");
        assert_eq!(serde_json::from_str::<Value>(&text).unwrap(), data);
    }

    #[test]
    fn the_policy_names_the_program_of_the_page_by_its_hash() {
        let page = page(&[], &json!({}), &[]);
        let script = page.rsplit_once("<script>").unwrap().1.split_once("</script>").unwrap().0;
        // FIPS 180-4 by the crate; that the browser agrees is checked in the browser.
        let hash = base64(&Sha256::digest(script.as_bytes()));
        assert!(page.contains(&format!("script-src 'sha256-{hash}'")));
        assert!(!page.contains("unsafe-inline"));
        // SHA-256 of the empty text, from the standard's examples.
        assert_eq!(base64(&Sha256::digest(b"")), "47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=");
    }

    #[test]
    fn limits_of_a_verdict_that_lacks_checks_are_none() {
        let worst = json!([{ "time_s": 2.0, "value": 3.0 }]);
        let check = json!({ "limit": 1.5, "exceeding_count": 1, "worst": worst });
        let axis = json!({ "velocity_mm_per_s": check, "position_step_mm": check });
        let verdict = json!({
            "axes": [axis, axis], "limits_respected": false, "total_time_s": 4.0,
            "max_velocity_mm_per_s": [3.0, 3.0], "max_acceleration_mm_per_s2": [0.0, 0.0],
            "max_velocity_step_mm_per_s": [0.0, 0.0], "max_acceleration_step_mm_per_s2": [0.0, 0.0],
        });
        let found = limits_json(&serde_json::from_value(verdict).unwrap());
        let expected = json!({ "limit": 1.5, "exceeding_count": 1, "worst": [[2.0, 3.0]] });
        assert_eq!(found["velocity"][0], expected);
        assert_eq!(found["steps"], json!([2.0, 2.0]));
        assert_eq!(found["jerk"][1], json!({ "limit": null, "exceeding_count": 0, "worst": [] }));
    }
}
