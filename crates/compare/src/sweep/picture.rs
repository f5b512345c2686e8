//! Picture of the front of residual against time, and the page of the sweep around it.

use planish_draw::{
    colour,
    frame::{Frame, Scale, range},
    page,
    svg::{Svg, put},
};
use planish_types::{
    outcome::sweep::{SettingValue, SweepPlan},
    text::{escaped, significant},
};

use super::{Residual, Table, heading, in_words, specification_in_words};

/// Height of the texts of the picture, px.
const FONT_PX: f64 = 14.0;

/// Width and height of the frame of the plot, px.
const SIZE_PX: [f64; 2] = [760.0, 420.0];

/// Margins of the plot, px: left, top, right and bottom.
const MARGIN_PX: [f64; 4] = [90.0, 40.0, 30.0, 60.0];

/// Largest number of points that are drawn beside those of the front. Larger: points that cannot be told apart, and a
/// slow page. Smaller: fewer plans in the picture. Chosen.
const MOST_POINTS: usize = 4000;

/// Room of an axis beyond the points at its ends: a factor of the value on a logarithmic axis; on a linear one, the
/// excess over 1 is a fraction of the range. Larger: empty borders. Smaller: points on the frame. Chosen.
const ROOM: f64 = 1.1;

/// Smallest ratio of the ends of an axis at which the axis is logarithmic. Larger: small values crowd at one end of a
/// linear axis. Smaller: few round numbers fit on a short logarithmic axis. Chosen.
const DECADES_FROM: f64 = 10.0;

/// Draws the plans that keep the constraints as points, each a link to its report; a line joins those on the front.
/// `to_table` is the path from the picture to the folder of the table. Empty if there is no point. `residual` chooses
/// the residual of the vertical axis.
pub fn svg(table: &Table, residual: Residual, to_table: &str) -> String {
    let front = table.front(residual);
    let points = points(table, residual, &front);
    if points.is_empty() {
        return String::new();
    }
    let scales = [0, 1].map(|k| {
        let [low, high] = range(points.iter().map(|(_, p)| p[k]));
        if low > 0.0 && high > DECADES_FROM * low {
            return Scale::logarithmic([low / ROOM, high * ROOM]);
        }
        let room = (ROOM - 1.0) * (high - low);
        Scale::linear([low - room, high + room])
    });
    let frame = Frame::new([0.0; 2], SIZE_PX, MARGIN_PX, scales);
    let mut svg = Svg::new(FONT_PX);
    frame.grid(&mut svg);
    frame.axes(&mut svg, ["time of the run (s)", residual.caption()]);
    let families = families(table);
    let entries: Vec<(&str, &str)> =
        families.iter().enumerate().map(|(k, name)| (name.as_str(), colour::of_line(k))).collect();
    frame.legend(&mut svg, &entries);
    // A plan is as good as all that takes longer: the front is a staircase.
    let corners = front.iter().filter_map(|&i| table.point(&table.0.plans[i], residual));
    let corners: Vec<[f64; 2]> = corners.collect();
    let stairs = corners.iter().enumerate().flat_map(|(k, &[time, rms])| {
        let landing = corners.get(k + 1).map(|next| [next[0], rms]);
        std::iter::once([time, rms]).chain(landing)
    });
    frame.curve(&mut svg, stairs, "#888888");
    let recommended = table.recommended();
    for (i, point) in points {
        let row = &table.0.plans[i];
        let family = families.iter().position(|name| *name == family_of(row)).unwrap_or(0);
        let [x, y] = frame.px(point);
        let (radius, opacity) = if front.contains(&i) { (5.0, 1.0) } else { (3.0, 0.55) };
        let ring =
            if recommended == Some(i) { " stroke=\"black\" stroke-width=\"2.5\"" } else { "" };
        let circle = format!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{}\" fill-opacity=\"{opacity}\"{ring}><title>{}</title></circle>",
            colour::of_line(family),
            escaped(&caption(row, point))
        );
        match &row.report {
            Some(report) => {
                let href = escaped(&format!("{to_table}{report}"));
                svg.put(format_args!("<a href=\"{href}\">{circle}</a>"));
            }
            None => svg.put(format_args!("{circle}")),
        }
    }
    svg.finish([MARGIN_PX[0] + SIZE_PX[0] + MARGIN_PX[2], MARGIN_PX[1] + SIZE_PX[1] + MARGIN_PX[3]])
}

/// Returns the plans to draw, each with its index and its point [time, s; residual, nm]. Those of the front come
/// last, so that they lie over the others.
fn points(table: &Table, residual: Residual, front: &[usize]) -> Vec<(usize, [f64; 2])> {
    let all = (0..table.0.plans.len())
        .filter_map(|i| Some((i, table.point(&table.0.plans[i], residual)?)));
    let (on_front, others): (Vec<_>, Vec<_>) = all.partition(|(i, _)| front.contains(i));
    let every = others.len().div_ceil(MOST_POINTS).max(1);
    others.into_iter().step_by(every).chain(on_front).collect()
}

/// Returns the family of a plan (its path and method), which has a colour of its own.
fn family_of(row: &SweepPlan) -> String {
    format!("{}, {}", row.path, row.method)
}

fn families(table: &Table) -> Vec<String> {
    let mut families: Vec<String> = table.0.plans.iter().map(family_of).collect();
    families.sort();
    families.dedup();
    families
}

/// Returns the text that describes a point: the plan, its residual and its time.
fn caption(row: &SweepPlan, [time_s, rms_nm]: [f64; 2]) -> String {
    format!("{}: {} nm in {} s", in_words(row), significant(rms_nm, 4), significant(time_s, 4))
}

/// CSS rules of this page, which follow the shared ones: the first column of a table holds numbers.
const STYLE: &str = "body { max-width: 75rem; }\nth:first-child { text-align: right; position: static; font-weight: 700; }\n\
                     tr.best td { font-weight: bold; }\n";

/// Returns the page of the sweep: the sentence, the pictures, the plans of the front, those without numbers, and all
/// plans, the two last up to `MOST_POINTS` of each. `to_table` is the path to the folder of the table.
pub fn page(table: &Table, to_table: &str) -> String {
    let title = format!("sweep {}, {}", table.0.name, table.0.mirror);
    let mut html =
        format!("<h1>Sweep {}, {}</h1>\n", escaped(&table.0.name), escaped(&table.0.mirror));
    put(&mut html, format_args!("<p>{}</p>\n", with_command(table)));
    put(&mut html, format_args!("<p>{}</p>\n", escaped(&constraints(table))));
    for residual in [Residual::Nominal, Residual::Below95] {
        html += &svg(table, residual, to_table);
    }
    html += "<p>Each point is a plan, and opens its report; a ring is around the one that is to be run. \
             The line joins the plans that no other beats in both time and residual.</p>\n";
    html += "<h2>The front</h2>\n";
    html += &rows(table, &table.front(table.judged_by()), to_table);
    let failed: Vec<usize> =
        (0..table.0.plans.len()).filter(|&i| table.0.plans[i].numbers.is_none()).collect();
    if !failed.is_empty() {
        put(&mut html, format_args!("<h2>{} plans without numbers</h2>\n<ul>", failed.len()));
        for row in failed.iter().take(MOST_POINTS).map(|&i| &table.0.plans[i]) {
            let message = row.message.as_deref().unwrap_or_default();
            put(
                &mut html,
                format_args!("<li>{}: {}</li>\n", escaped(&in_words(row)), escaped(message)),
            );
        }
        html += "</ul>\n";
    }
    let shown = table.0.plans.len().min(MOST_POINTS);
    put(
        &mut html,
        format_args!("<details><summary>{shown} of {} plans</summary>\n", table.0.plans.len()),
    );
    html += &rows(table, &(0..shown).collect::<Vec<_>>(), to_table);
    html += "</details>\n<p>All plans with all their numbers are in <a href=\"table.csv\">table.csv</a>.</p>\n";
    page::document(&title, page::WITHOUT_PROGRAM, &page::style(STYLE), &html)
}

/// Returns the sentence on the plan to be run as HTML, with its command set as code.
fn with_command(table: &Table) -> String {
    let sentence = table.sentence();
    match sentence.split_once("planish run ") {
        Some((before, settings)) => {
            format!("{}<code>planish run {}</code>", escaped(before), escaped(settings))
        }
        None => escaped(&sentence),
    }
}

/// Returns a sentence on the constraints that the plans of the front must keep.
fn constraints(table: &Table) -> String {
    let constraints = &table.0.constraints;
    let mut conditions: Vec<String> = Vec::new();
    if constraints.keep_limits {
        conditions.push("keeps the limits of the machine".into());
    }
    if constraints.keep_specification && !table.specified().is_empty() {
        conditions.push("keeps the specification".into());
    }
    if let Some(s) = constraints.max_time_s {
        conditions.push(format!("takes {} s at most", significant(s, 6)));
    }
    let failed = table.failed();
    let judged = match table.judged_by() {
        Residual::Nominal => "its residual without errors",
        Residual::Below95 => "the residual that 95 % of its runs are below",
    };
    let conditions =
        if conditions.is_empty() { "is made".into() } else { conditions.join(" and ") };
    format!(
        "A plan counts that {conditions}; it is judged by {judged} and by its time. {failed} plans have no numbers."
    )
}

/// Returns the HTML table of the plans with these indices, without those that have no numbers. `to_table` is the path
/// to the folder of the table.
fn rows(table: &Table, indices: &[usize], to_table: &str) -> String {
    let varied = table.varied();
    let mut html =
        String::from("<div class=\"scroll\"><table><tr><th>time, s</th><th>residual, nm</th>");
    if table.0.has_process {
        html += "<th>95 % below, nm</th>";
    }
    html += "<th class=\"words\">limits</th>";
    let limits = table.specified();
    if !limits.is_empty() {
        html += "<th class=\"words\">specification</th>";
    }
    for limit in limits {
        put(&mut html, format_args!("<th class=\"words\">{}</th>", escaped(&heading(limit))));
    }
    html += "<th class=\"words\">path</th><th class=\"words\">method</th>";
    for key in &varied {
        put(&mut html, format_args!("<th>{}</th>", escaped(key)));
    }
    html += "<th class=\"words\">plan</th></tr>\n";
    let recommended = table.recommended();
    for &i in indices {
        let row = &table.0.plans[i];
        let Some(n) = &row.numbers else { continue };
        html += if recommended == Some(i) { "<tr class=\"best\">" } else { "<tr>" };
        let mut numbers = vec![Some(n.total_time_s), Some(n.rms_nm)];
        if table.0.has_process {
            numbers.push(n.below_95_percent_nm);
        }
        for number in numbers {
            let number = number.map(|x| significant(x, 4)).unwrap_or_default();
            put(&mut html, format_args!("<td>{number}</td>"));
        }
        let limits_kept = if n.limits_kept { "kept" } else { "exceeded" };
        put(&mut html, format_args!("<td class=\"words\">{limits_kept}</td>"));
        if !limits.is_empty() {
            let words = specification_in_words(n);
            put(&mut html, format_args!("<td class=\"words\">{words}</td>"));
        }
        for k in 0..limits.len() {
            let limit = n.specification.as_ref().and_then(|s| s.limits.get(k));
            let value = limit.and_then(|l| l.value).map(|v| significant(v, 4)).unwrap_or_default();
            let class = if limit.is_some_and(|l| !l.passed) { " class=\"bad\"" } else { "" };
            put(&mut html, format_args!("<td{class}>{value}</td>"));
        }
        put(
            &mut html,
            format_args!(
                "<td class=\"words\">{}</td><td class=\"words\">{}</td>",
                escaped(&row.path),
                escaped(&row.method)
            ),
        );
        for key in &varied {
            let value = row.settings.get(*key).map(SettingValue::to_string).unwrap_or_default();
            put(&mut html, format_args!("<td>{}</td>", escaped(&value)));
        }
        let name = escaped(&row.id);
        let cell = match &row.report {
            Some(report) => {
                format!("<a href=\"{}\">{name}</a>", escaped(&format!("{to_table}{report}")))
            }
            None => name,
        };
        put(&mut html, format_args!("<td class=\"words\">{cell}</td></tr>\n"));
    }
    html + "</table></div>\n"
}

#[cfg(test)]
mod tests {
    use super::{super::tests::table, *};

    #[test]
    fn every_plan_is_a_point_that_opens_its_report() {
        let plans = [(10.0, 1.0, true), (5.0, 2.0, true), (11.0, 1.5, true), (1.0, 0.1, false)];
        let table = table(&plans, None);
        let svg = svg(&table, Residual::Nominal, "../");
        assert_eq!(svg.matches("<a href=\"../plans/").count(), 3);
        // The shortest first: left and above.
        let of = |r: &str| svg.matches(&format!("r=\"{r}\"")).count();
        assert_eq!((of("5"), of("3")), (2, 1));
        assert_eq!(svg.matches("stroke=\"black\" stroke-width=\"2.5\"").count(), 1);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert!(super::svg(&table, Residual::Below95, "").is_empty());
    }

    #[test]
    fn names_are_no_markup() {
        let mut table = table(&[(10.0, 1.0, true)], None);
        table.0.name = "<script>".into();
        table.0.plans[0].path = "\"><script>".into();
        table.0.plans[0].report = Some("\"><script>".into());
        table.0.plans[0].again = "planish run <script>".into();
        let page = page(&table, "");
        assert!(!page.contains("<script>"), "{page}");
    }
}
