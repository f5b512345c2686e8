//! Answers to requests.

use std::io::{self, Read, Write};

use planish_app::{
    after::NEXT_RUN,
    guard::{ChoiceKind, Head, MOST_CHOICE_BYTES, MOST_UPLOAD_BYTES, Route},
    refusal::Refusal,
    session::{Session, StepName},
};
use planish_draw::{colour, page};
use serde::Serialize;

use super::{
    estimate,
    map::map_bytes,
    server::{Server, read_json},
};

/// Policy of the page: it loads and runs only what this server sends.
const PAGE_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; \
                           connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// Policy of the report, in addition to its own: a place of its own, from which it can ask this server nothing.
const REPORT_POLICY: &str = "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; \
                             style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'";

/// Report of the next run, in its directory.
const NEXT_REPORT: &str = "plan/report/report.html";
const HTML: &str = "text/html; charset=utf-8";
const JSON: &str = "application/json";

/// An answer.
pub struct Answer {
    status: u16,
    content_type: &'static str,
    policy: &'static str,
    /// Name under which the browser saves the answer; `None` if it shows it.
    download: Option<String>,
    body: Vec<u8>,
}

/// State of a session, as the page asks for it.
#[derive(Serialize)]
struct StateReport<'a> {
    session: &'a Session,
    /// Step that runs, and the time since it began, s.
    running: Option<(StepName, f64)>,
    /// Messages of each step, by its name.
    messages: Vec<(StepName, String)>,
    /// Names of the pipelines.
    pipelines: Vec<&'a String>,
    /// Paths of the reports of the run and of the next one.
    reports: [String; 2],
    /// True for each of these reports that is there.
    has_reports: [bool; 2],
    /// Folder of the fixtures, for the command lines that the page composes.
    folder: &'a str,
    /// Name of the program of the run; empty if there is none.
    program: String,
    /// Directory of the session.
    directory: String,
    /// Colours of a map, from the smallest to the largest value.
    colours: [&'static str; 7],
}

/// Returns the answer to a request; its body follows in `body`.
pub fn respond(server: &std::sync::Arc<Server>, head: &Head, body: &mut dyn Read) -> Answer {
    let answer = server.guard.admit(head).and_then(|route| match route {
        Route::Asset(name) => Ok(asset(&name)),
        Route::State => state(server),
        Route::Map(name) => Ok(Answer::new("application/octet-stream", map_bytes(server, name)?)),
        Route::Pipeline(name) => match server.pipelines.get(&name) {
            Some(pipeline) => json(pipeline),
            None => Err(Refusal::new(404, "there is no such pipeline")),
        },
        Route::Machine => machine(server),
        Route::Script => Ok(Answer::download("session.sh", server.files.script()?)),
        Route::Program => program(server),
        Route::Report => Ok(report(run_file(server, "report/report.html")?)),
        Route::NextReport => {
            let path = server.files.inside(&format!("{NEXT_RUN}/{NEXT_REPORT}"))?;
            Ok(report(server.files.read(&path)?))
        }
        Route::PathPicture(name) => {
            let tool = server.live().session.tool.as_ref().map(|step| step.choice.source.clone());
            let end = tool.map_or("", |tool| tool.run_suffix());
            let path = server.files.inside(&format!("estimates/{name}{end}/tool_path.svg"))?;
            Ok(Answer::new("image/svg+xml", server.files.read(&path)?))
        }
        Route::Estimate => {
            let choice = read_json(&choice_bytes(head, body)?)?;
            json(&estimate::answer(server, &choice)?)
        }
        Route::Answer => Ok(Answer::new(JSON, run_file(server, "report/summary.json")?)),
        Route::Upload(role, name) => {
            let length = head.body_bytes(MOST_UPLOAD_BYTES)?;
            server.files.receive(role, &name, length, body)?;
            json(&name)
        }
        Route::Choice(kind) => {
            let bytes = choice_bytes(head, body)?;
            match kind {
                ChoiceKind::Part => server.choose_part(read_json(&bytes)?),
                ChoiceKind::Tool => server.choose_tool(read_json(&bytes)?),
                ChoiceKind::Machine => server.choose_machine(&bytes),
                ChoiceKind::Plan => server.choose_plan(read_json(&bytes)?),
                ChoiceKind::After => server.choose_after(read_json(&bytes)?),
                ChoiceKind::Demo => server.begin_demo(),
            }?;
            state(server)
        }
        Route::Cancel => {
            server.cancel();
            state(server)
        }
    });
    answer.unwrap_or_else(|refusal| Answer::of_refusal(&refusal))
}

/// Reads the body of a choice.
fn choice_bytes(head: &Head, body: &mut dyn Read) -> Result<Vec<u8>, Refusal> {
    let mut bytes = Vec::new();
    let length = head.body_bytes(MOST_CHOICE_BYTES)?;
    let read = body.take(length).read_to_end(&mut bytes);
    read.map_err(|e| Refusal::of_value(format!("the choice ended early: {e}")))?;
    Ok(bytes)
}

/// Returns a report, which has a program of its own and texts of files.
fn report(bytes: Vec<u8>) -> Answer {
    Answer { policy: REPORT_POLICY, ..Answer::new(HTML, bytes) }
}

impl Answer {
    fn new(content_type: &'static str, body: Vec<u8>) -> Self {
        Self { status: 200, content_type, policy: PAGE_POLICY, download: None, body }
    }

    fn download(name: &str, body: Vec<u8>) -> Self {
        Self { download: Some(name.into()), ..Self::new("application/octet-stream", body) }
    }

    /// Returns the answer that a request is refused: one sentence.
    pub fn of_refusal(refusal: &Refusal) -> Self {
        let body = refusal.sentence.clone().into_bytes();
        Self { status: refusal.status, ..Self::new("text/plain; charset=utf-8", body) }
    }

    /// Writes the answer, after which the connection ends.
    ///
    /// # Errors
    /// Fails if the browser has gone.
    pub fn write(&self, stream: &mut dyn Write) -> io::Result<()> {
        let Self { status, content_type, policy, download, body } = self;
        let length = body.len();
        write!(
            stream,
            "HTTP/1.1 {status} -\r\nContent-Type: {content_type}\r\nContent-Length: {length}\r\nConnection: close\r\n\
             Cache-Control: no-store\r\nContent-Security-Policy: {policy}\r\nX-Content-Type-Options: nosniff\r\n\
             Referrer-Policy: no-referrer\r\nCross-Origin-Resource-Policy: same-origin\r\n\
             Cross-Origin-Opener-Policy: same-origin\r\n"
        )?;
        if let Some(name) = download {
            write!(stream, "Content-Disposition: attachment; filename=\"{name}\"\r\n")?;
        }
        stream.write_all(b"\r\n")?;
        stream.write_all(body)?;
        stream.flush()
    }
}

/// Returns a file of the page.
fn asset(name: &str) -> Answer {
    match name {
        "page.css" => {
            let style = page::style(include_str!("../page/page.css"));
            Answer::new("text/css; charset=utf-8", style.into_bytes())
        }
        "canvas.js" => program_text(include_str!("../page/canvas.js")),
        "map.js" => program_text(include_str!("../page/map.js")),
        "reading.js" => program_text(include_str!("../page/reading.js")),
        "machine.js" => program_text(include_str!("../page/machine.js")),
        "plan.js" => program_text(include_str!("../page/plan.js")),
        "estimate.js" => program_text(include_str!("../page/estimate.js")),
        "result.js" => program_text(include_str!("../page/result.js")),
        "after.js" => program_text(include_str!("../page/after.js")),
        "page.js" => program_text(include_str!("../page/page.js")),
        _ => Answer::new(HTML, include_bytes!("../page/page.html").to_vec()),
    }
}

fn program_text(text: &str) -> Answer {
    Answer::new("text/javascript; charset=utf-8", text.into())
}

fn json(value: &impl Serialize) -> Result<Answer, Refusal> {
    let text = serde_json::to_vec(value);
    Ok(Answer::new(JSON, text.map_err(|e| Refusal::new(500, e.to_string()))?))
}

fn state(server: &Server) -> Result<Answer, Refusal> {
    let live = server.live();
    let messages = StepName::ALL.map(|step| (step, server.files.text_end(step.log())));
    let run_has = |path: &str| {
        !live.session.run.is_empty()
            && server.files.inside(&format!("{}/{path}", live.session.run)).is_ok()
    };
    json(&StateReport {
        session: &live.session,
        running: live.job.as_ref().map(|job| (job.step, job.begun.elapsed().as_secs_f64())),
        messages: messages.to_vec(),
        pipelines: server.pipelines.keys().collect(),
        reports: server.guard.reports(),
        has_reports: [
            run_has("report/report.html"),
            server.files.inside(&format!("{NEXT_RUN}/{NEXT_REPORT}")).is_ok(),
        ],
        folder: server.folder(),
        program: program_name(&live.session).filter(|name| run_has(name)).unwrap_or_default(),
        directory: server.files.dir.display().to_string(),
        colours: colour::BLUE_TO_BROWN,
    })
}

/// Returns the name of the program that the plan of the session writes; `None` if it writes none.
fn program_name(session: &Session) -> Option<String> {
    let controller = session.plan.as_ref()?.done()?.controller()?;
    Some(format!("program.{controller}"))
}

fn program(server: &Server) -> Result<Answer, Refusal> {
    let name = program_name(&server.live().session);
    let name = name.ok_or_else(|| Refusal::new(404, "the plan has written no program"))?;
    Ok(Answer::download(&name, run_file(server, &name)?))
}

/// Reads a file of the run of the session.
fn run_file(server: &Server, path: &str) -> Result<Vec<u8>, Refusal> {
    let run = server.live().session.run.clone();
    if run.is_empty() {
        return Err(Refusal::new(404, "there is no run yet"));
    }
    server.files.read(&server.files.inside(&format!("{run}/{path}"))?)
}

/// Returns the text of the machine file of the session.
fn machine(server: &Server) -> Result<Answer, Refusal> {
    let machine = server.live().session.machine.clone();
    let machine = machine.ok_or_else(|| Refusal::new(404, "no machine is chosen yet"))?;
    let path = server.files.dir.join(machine.path(server.folder())?);
    Ok(Answer::new(JSON, server.files.read(&path)?))
}
