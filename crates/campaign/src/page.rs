//! Report page of a campaign: one HTML page without scripts, with the curve of the residuals over the runs.

use std::fmt::Write;

use planish_draw::{Frame, Scale, Svg, colour::LINES, frame::range, page};
use planish_types::text::{escaped, significant};

use crate::summary::{Campaign, Chains, LearntParameter};

/// Height of the texts of the picture, px. Larger texts need larger margins.
const FONT_PX: f64 = 14.0;
/// Width and height of the frame of the plot, px.
const SIZE: [f64; 2] = [560.0, 300.0];
/// Margins to the left of the frame, above, to the right and below it, px: room for numbers and titles.
const MARGIN: [f64; 4] = [64.0, 34.0, 24.0, 50.0];

/// Names of the chains (series of runs, see `summary`) on the page, in the order of [`Chains::each`].
const CHAINS: [&str; 3] = ["with learning", "without", "known tool"];

/// CSS rules of this page, which follow the style that all pages share.
const STYLE: &str = "body { max-width: 1000px; }\n";

/// Draws the RMS on the mirror before the first run and after every run, one curve per chain. Returns SVG text.
pub fn picture(campaign: &Campaign) -> String {
    let mut svg = Svg::new(FONT_PX);
    let mut lines = [(); 3].map(|()| vec![[0.0, campaign.before_rms_nm]]);
    for run in &campaign.runs {
        for (line, left) in lines.iter_mut().zip(run.left.each()) {
            line.push([run.number as f64, left.rms_nm]);
        }
    }
    let all = lines.iter().flatten().map(|p| p[1]).filter(|v| *v > 0.0);
    let [low, high] = range(all);
    let scales = [
        Scale::linear([0.0, campaign.runs.len() as f64]),
        Scale::logarithmic([0.7 * low, 1.4 * high]),
    ];
    let frame = Frame::new([0.0, 0.0], SIZE, MARGIN, scales);
    frame.grid(&mut svg);
    frame.axes(&mut svg, ["runs", "residual on the mirror (nm RMS)"]);
    let mut entries = Vec::new();
    // The known tool is drawn first, so that a curve on top of it stays visible.
    for k in [2, 1, 0] {
        frame.curve(&mut svg, lines[k].iter().copied(), LINES[k]);
        entries.insert(0, (CHAINS[k], LINES[k]));
    }
    frame.legend(&mut svg, &entries);
    svg.finish([SIZE[0] + MARGIN[0] + MARGIN[2], SIZE[1] + MARGIN[1] + MARGIN[3]])
}

/// Returns the report page of the campaign as HTML.
pub fn page(campaign: &Campaign) -> String {
    let mirror = escaped(&campaign.mirror);
    let mut out = format!("<h1>Campaign on {mirror}</h1>\n<p>{}</p>\n", escaped(&answer(campaign)));
    if let Some(sentence) = &campaign.assumed_machine {
        out += &format!("<p><strong>{}</strong></p>\n", escaped(sentence));
    }
    out += "<h2>What every run left</h2>\n<div class=\"scroll\"><table>\n<tr><th>run</th>";
    for chain in CHAINS {
        let _ = write!(out, "<th>{chain}, nm RMS</th><th>time, min</th>");
    }
    out += "<th>with learning / known tool</th><th>without / known tool</th></tr>\n";
    let before = significant(campaign.before_rms_nm, 5);
    let each = format!("<td>{before}</td><td></td>").repeat(CHAINS.len());
    let _ = writeln!(out, "<tr><th>before</th>{each}<td></td><td></td></tr>");
    for run in &campaign.runs {
        row(&mut out, &run.number.to_string(), &run.left);
    }
    row(&mut out, "another mirror like it", &campaign.alike);
    out += "</table></div>\n";
    out += &picture(campaign);
    out += "<p class=\"note\">RMS of what is truly on the mirror, its mean removed, which only the virtual machine knows. \
            The first run is the same with and without learning. The last row is the first run on another mirror like this \
            one, after all that was learnt.</p>\n<h2>What was decided</h2>\n\
            <div class=\"scroll\"><table>\n<tr><th>after run</th><th>measured, nm</th><th>expected of the next run, nm \
            (95 %)</th><th>it left, nm</th><th>decision</th></tr>\n";
    for (k, run) in campaign.runs.iter().enumerate() {
        let [median, low, high] = run.expected_nm;
        let left = campaign.runs.get(k + 1).map(|next| format!("{:.4}", next.left.learning.rms_nm));
        let _ = writeln!(
            out,
            "<tr><th>{}</th><td>{:.4}</td><td>{median:.4} ({low:.4} to {high:.4})</td><td>{}</td>\
             <td class=\"words\"><b>{}</b>: {}</td></tr>",
            run.number,
            run.measured_rms_nm,
            left.unwrap_or_default(),
            run.verdict.words(),
            escaped(&run.reason)
        );
    }
    out += "</table></div>\n<h2>What was learnt</h2>\n<div class=\"scroll\"><table>\n<tr><th>parameter</th><th>hidden \
            truth</th>";
    for run in &campaign.runs {
        let _ = write!(out, "<th>after run {}</th><th>off, standard errors</th>", run.number);
    }
    out += "</tr>\n";
    let parameters = campaign.runs.first().map_or(0, |run| run.parameters.len());
    for p in 0..parameters {
        let first = &campaign.runs[0].parameters[p];
        let truth = first.truth.map_or(String::new(), |t| significant(t, 4));
        let unit = escaped(&first.unit);
        let _ = write!(out, "<tr><th>{}, {unit}</th><td>{truth}</td>", escaped(&first.name));
        for run in &campaign.runs {
            let Some(parameter) = run.parameters.get(p) else { continue };
            let why = parameter.refused.as_deref().map_or(String::new(), escaped);
            let (value, off) = value_and_deviation(parameter);
            let _ = write!(out, "<td title=\"{why}\">{value}</td><td>{off}</td>");
        }
        out += "</tr>\n";
    }
    out += "</table></div>\n<p class=\"note\">A number in brackets is that of an earlier run: this run did not \
            determine it better than it was known (the reason is shown where the mouse rests on it).</p>\n";
    let title = format!("campaign on {}", campaign.mirror);
    page::document(&title, page::WITHOUT_PROGRAM, &page::style(STYLE), &out)
}

/// Appends to `out` a row of the table of residuals: the RMS (nm) and time (min) of each chain, and the ratios to the
/// known tool.
fn row(out: &mut String, name: &str, chains: &Chains) {
    let _ = write!(out, "<tr><th>{name}</th>");
    for left in chains.each() {
        let _ = write!(out, "<td>{:.4}</td><td>{:.1}</td>", left.rms_nm, left.total_time_s / 60.0);
    }
    let [learning, without] = chains.over_known();
    let _ = writeln!(out, "<td>{learning:.3}</td><td>{without:.3}</td></tr>");
}

/// Writes a learnt value with its standard error, and its deviation from the truth in standard errors, as HTML text.
/// The first is "not determined" if no run determined the value. The second is then empty, as it is if the truth is
/// unknown or the standard error is 0. Brackets mark a value from an earlier run.
pub fn value_and_deviation(parameter: &LearntParameter) -> (String, String) {
    let (Some(value), Some(error)) = (parameter.value, parameter.standard_error) else {
        return ("not determined".into(), String::new());
    };
    let number = format!("{} &plusmn; {}", significant(value, 4), significant(error, 2));
    let number = if parameter.is_of_this_run { number } else { format!("({number})") };
    let off =
        parameter.truth.filter(|_| error > 0.0).map(|t| format!("{:.1}", (value - t) / error));
    (number, off.unwrap_or_default())
}

/// Returns sentences with the RMS on the mirror, nm, after the last run with learning, without learning and with a
/// known tool, and after the first run on another mirror like it. They are empty if there is no run.
pub fn answer(campaign: &Campaign) -> String {
    let Some(last) = campaign.runs.last() else { return String::new() };
    let count = match campaign.runs.len() {
        1 => "1 run".into(),
        n => format!("{n} runs"),
    };
    let [learning, without] = campaign.alike.over_known();
    format!(
        "{} nm RMS before; after {count} {:.4} nm with learning, {:.4} nm without, {:.4} nm with a tool that is known. \
         The first run on another mirror like it leaves {:.4} nm with what was learnt ({learning:.2} times what the known \
         tool leaves) and {:.4} nm without ({without:.2} times)",
        significant(campaign.before_rms_nm, 5),
        last.left.learning.rms_nm,
        last.left.without.rms_nm,
        last.left.known.rms_nm,
        campaign.alike.learning.rms_nm,
        campaign.alike.without.rms_nm
    )
}
