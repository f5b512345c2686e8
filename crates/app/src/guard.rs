//! Guard of the server: decides from the head of a request whether it is answered, and by what.
//!
//! A page of another site can send requests to this server, and a user of the same machine can connect to it. Therefore
//! every request needs a random token in its path and the name of this server in `Host`. A request that changes
//! something also needs `Origin`. No path of a request is ever joined to a path of the disk, but the name of an uploaded
//! file, which has no separator.

use crate::refusal::Refusal;

/// Largest head of a request, bytes. Larger: more memory for each connection. Smaller: browsers with many cookies of
/// other servers on this host are refused.
pub const MOST_HEAD_BYTES: usize = 16 << 10;
/// Largest body of a choice, bytes; a machine file is the longest.
pub const MOST_CHOICE_BYTES: u64 = 256 << 10;
/// Largest uploaded file, bytes. The readers take maps of up to this size.
pub const MOST_UPLOAD_BYTES: u64 = 2 << 30;
/// Files of the page beside the page itself, in the order of its scripts.
pub const ASSETS: [&str; 10] = [
    "page.css",
    "canvas.js",
    "map.js",
    "reading.js",
    "machine.js",
    "plan.js",
    "estimate.js",
    "result.js",
    "after.js",
    "page.js",
];
/// Largest number of headers of a request.
const MOST_HEADERS: usize = 64;
/// Largest length of the name of an uploaded file, bytes; file systems allow 255.
const MOST_NAME_BYTES: usize = 120;

/// Head of a request: its first line and its headers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Head {
    method: String,
    target: String,
    headers: Vec<(String, String)>,
}

/// Answers that a request can ask for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Route {
    /// A file of the page, by its name; the page itself has an empty name.
    Asset(String),
    /// State of the session.
    State,
    /// Map of a step, for its drawing.
    Map(MapName),
    /// Settings of a pipeline, by its name.
    Pipeline(String),
    /// The machine file that the session uses.
    Machine,
    /// The session as a script.
    Script,
    /// The program for the controller.
    Program,
    /// The report of the run.
    Report,
    /// The report of the next run.
    NextReport,
    /// Answer of the report: the plan that is to be run.
    Answer,
    /// Picture of the path of an estimate, by the name of its pipeline.
    PathPicture(String),
    /// An estimate of the plan in the body.
    Estimate,
    /// A file that the user gives for a part or a tool.
    Upload(Role, String),
    /// A choice of the user, in the body.
    Choice(ChoiceKind),
    /// The end of the running job.
    Cancel,
}

/// Maps that the page draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MapName {
    /// The part as the plan takes it: levelled and masked.
    Part,
    /// The tool.
    Tool,
    /// A tool that varies, at some places of the part.
    Places,
    /// The part as the run has it.
    Before,
    /// The removal of the plan that is to be run.
    Removal,
    /// The residual that this plan leaves.
    Residual,
    /// The map measured after the run.
    After,
}

/// Purposes of an uploaded file. Each has a folder of its own in the session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Map of the part.
    Part,
    /// Map of the tool, or of the spot after the tool acted.
    Tool,
    /// Map of the spot before the tool acted.
    Before,
    /// A file of a tool that varies.
    Varying,
    /// Map of the part after the run.
    After,
}

/// Steps whose choice a request can send.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChoiceKind {
    /// The part.
    Part,
    /// The tool.
    Tool,
    /// The machine.
    Machine,
    /// The plan.
    Plan,
    /// The map after the run.
    After,
    /// The demonstration: part, tool, machine and plan.
    Demo,
}

impl Role {
    /// Returns the name of the folder of the role.
    pub fn folder(self) -> &'static str {
        match self {
            Self::Part => "part",
            Self::Tool => "tool",
            Self::Before => "before",
            Self::Varying => "varying",
            Self::After => "after",
        }
    }
}

impl Head {
    /// Reads the head of a request; `bytes` end with the empty line.
    ///
    /// # Errors
    /// Refuses what is no head of HTTP/1.
    pub fn read(bytes: &[u8]) -> Result<Self, Refusal> {
        let mut headers = [httparse::EMPTY_HEADER; MOST_HEADERS];
        let mut request = httparse::Request::new(&mut headers);
        let is_complete = request.parse(bytes).is_ok_and(|status| status.is_complete());
        let (true, Some(method), Some(target)) = (is_complete, request.method, request.path) else {
            return Err(Refusal::of_value("the request is no HTTP"));
        };
        let mut read = Vec::new();
        for header in request.headers.iter() {
            let value = str::from_utf8(header.value)
                .map_err(|_| Refusal::of_value(format!("{} is no text", header.name)))?;
            read.push((header.name.to_ascii_lowercase(), value.trim().to_string()));
        }
        Ok(Self { method: method.into(), target: target.into(), headers: read })
    }

    /// Returns the value of the header `name`, in small letters; `None` if it is absent.
    ///
    /// # Errors
    /// Refuses a header that is there twice.
    pub fn header(&self, name: &str) -> Result<Option<&str>, Refusal> {
        let mut values = self.headers.iter().filter(|(known, _)| known == name);
        let first = values.next().map(|(_, value)| value.as_str());
        match values.next() {
            None => Ok(first),
            Some(_) => Err(Refusal::of_value(format!("{name} is there twice"))),
        }
    }

    /// Returns the length of the body, bytes.
    ///
    /// # Errors
    /// Refuses a body without a length, and one of more than `most` bytes.
    pub fn body_bytes(&self, most: u64) -> Result<u64, Refusal> {
        if self.header("transfer-encoding")?.is_some() {
            return Err(Refusal::new(411, "the body has no length; send Content-Length"));
        }
        let Some(text) = self.header("content-length")? else { return Ok(0) };
        let is_digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        match text.parse::<u64>() {
            Ok(length) if is_digits && length <= most => Ok(length),
            Ok(_) if is_digits => Err(Refusal::new(
                413,
                format!("the file has {text} bytes; at most {most} are taken"),
            )),
            _ => Err(Refusal::of_value(format!("Content-Length is '{text}', not a number"))),
        }
    }
}

/// Guard of one server.
#[derive(Clone, Debug)]
pub struct Guard {
    /// Names of this server as `Host` states them, with the port.
    hosts: [String; 2],
    /// Token of the page, which may do everything.
    token: String,
    /// Token of the report, which may read the report alone: it is a page with a program and with texts of files.
    report_token: String,
}

impl Guard {
    /// Creates the guard of the server at `port`, with its two tokens.
    pub fn new(port: u16, token: String, report_token: String) -> Self {
        let hosts = ["127.0.0.1", "localhost"].map(|name| format!("{name}:{port}"));
        Self { hosts, token, report_token }
    }

    /// Returns the path of the page.
    pub fn page(&self) -> String {
        format!("/{}/", self.token)
    }

    /// Returns the paths of the report of the run, and of that of the next run.
    pub fn reports(&self) -> [String; 2] {
        ["report.html", "next.html"].map(|name| format!("/{}/{name}", self.report_token))
    }

    /// Returns what an allowed request asks for.
    ///
    /// # Errors
    /// Refuses a wrong or absent `Host` or token, another origin, and a path that does not exist.
    pub fn admit(&self, head: &Head) -> Result<Route, Refusal> {
        let host = head.header("host")?.unwrap_or_default();
        if !self.hosts.iter().any(|known| known == host) {
            return Err(Refusal::new(403, "this server answers to its own name alone"));
        }
        let changes = match head.method.as_str() {
            "GET" => false,
            "POST" => true,
            _ => return Err(Refusal::new(405, "the method is neither GET nor POST")),
        };
        let own_origin = format!("http://{host}");
        match head.header("origin")? {
            Some(origin) if origin == own_origin => {}
            None if !changes => {}
            _ => return Err(Refusal::new(403, "the request is of another page")),
        }
        if head
            .header("sec-fetch-site")?
            .is_some_and(|site| site != "same-origin" && site != "none")
        {
            return Err(Refusal::new(403, "the request is of another site"));
        }
        let parts: Vec<&str> = head.target.split('/').collect();
        let [first, token, path @ ..] = parts.as_slice() else { return Err(no_such_path()) };
        if !first.is_empty() {
            return Err(no_such_path());
        }
        if same(token, &self.report_token) && !changes {
            return match path {
                ["report.html"] => Ok(Route::Report),
                ["next.html"] => Ok(Route::NextReport),
                _ => Err(Refusal::new(403, "this token reads reports alone")),
            };
        }
        if !same(token, &self.token) {
            return Err(Refusal::new(
                403,
                "the address has no valid token; open the address that planish app has printed",
            ));
        }
        route(changes, path)
    }
}

/// Returns what the path after the token asks for.
fn route(changes: bool, path: &[&str]) -> Result<Route, Refusal> {
    Ok(match (changes, path) {
        (false, [name]) if name.is_empty() || ASSETS.contains(name) => Route::Asset((*name).into()),
        (false, ["state"]) => Route::State,
        (false, ["map", "part"]) => Route::Map(MapName::Part),
        (false, ["map", "tool"]) => Route::Map(MapName::Tool),
        (false, ["map", "places"]) => Route::Map(MapName::Places),
        (false, ["map", "before"]) => Route::Map(MapName::Before),
        (false, ["map", "removal"]) => Route::Map(MapName::Removal),
        (false, ["map", "residual"]) => Route::Map(MapName::Residual),
        (false, ["map", "after"]) => Route::Map(MapName::After),
        (false, ["path", name]) if is_word(name) => Route::PathPicture((*name).into()),
        (false, ["pipeline", name]) if is_word(name) => Route::Pipeline((*name).into()),
        (false, ["machine.json"]) => Route::Machine,
        (false, ["session.sh"]) => Route::Script,
        (false, ["program"]) => Route::Program,
        (false, ["answer"]) => Route::Answer,
        (true, ["upload", role, name]) => {
            let role = match *role {
                "part" => Role::Part,
                "tool" => Role::Tool,
                "before" => Role::Before,
                "varying" => Role::Varying,
                "after" => Role::After,
                _ => return Err(no_such_path()),
            };
            check_file_name(name)?;
            Route::Upload(role, (*name).into())
        }
        (true, ["part"]) => Route::Choice(ChoiceKind::Part),
        (true, ["tool"]) => Route::Choice(ChoiceKind::Tool),
        (true, ["machine"]) => Route::Choice(ChoiceKind::Machine),
        (true, ["plan"]) => Route::Choice(ChoiceKind::Plan),
        (true, ["after"]) => Route::Choice(ChoiceKind::After),
        (true, ["estimate"]) => Route::Estimate,
        (true, ["demo"]) => Route::Choice(ChoiceKind::Demo),
        (true, ["cancel"]) => Route::Cancel,
        _ => return Err(no_such_path()),
    })
}

/// Refuses a name that could be anything else than the name of a file in one folder.
///
/// # Errors
/// Refuses separators, `..`, hidden files, names that a device has, and long names.
pub fn check_file_name(name: &str) -> Result<(), Refusal> {
    let is_plain = name.bytes().all(|b| b.is_ascii_alphanumeric() || b"._+-".contains(&b));
    if name.is_empty() || name.len() > MOST_NAME_BYTES || !is_plain || name.starts_with(['.', '-'])
    {
        return Err(Refusal::of_value(format!(
            "'{}' is no name for a file here; use letters, digits and . _ + - ({MOST_NAME_BYTES} at most)",
            name.escape_debug()
        )));
    }
    Ok(())
}

/// Returns true if `name` can be the name of a pipeline, a fixture or a machine.
pub fn is_word(name: &str) -> bool {
    check_file_name(name).is_ok()
}

fn no_such_path() -> Refusal {
    Refusal::new(404, "there is nothing at this address")
}

/// Returns true if the texts are the same. The time depends on their lengths alone, so that it tells nothing of a token.
fn same(given: &str, token: &str) -> bool {
    let differences = given.bytes().zip(token.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
    given.len() == token.len() && differences == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn guard() -> Guard {
        Guard::new(8123, "a".repeat(32), "b".repeat(32))
    }

    /// Returns the answer of the guard to a request with these lines.
    fn admit(lines: &[&str]) -> Result<Route, Refusal> {
        let text = format!("{}\r\n\r\n", lines.join("\r\n"));
        guard().admit(&Head::read(text.as_bytes())?)
    }

    fn status(lines: &[&str]) -> u16 {
        admit(lines).map_or_else(|refusal| refusal.status, |_| 200)
    }

    const HOST: &str = "Host: 127.0.0.1:8123";
    const ORIGIN: &str = "Origin: http://127.0.0.1:8123";

    #[test]
    fn the_page_of_this_server_is_answered() {
        let page = format!("GET /{}/ HTTP/1.1", "a".repeat(32));
        assert_eq!(admit(&[&page, HOST]), Ok(Route::Asset(String::new())));
        let part = format!("POST /{}/part HTTP/1.1", "a".repeat(32));
        assert_eq!(admit(&[&part, HOST, ORIGIN]), Ok(Route::Choice(ChoiceKind::Part)));
        let local = ["Host: localhost:8123", "Origin: http://localhost:8123"];
        assert_eq!(status(&[&part, local[0], local[1]]), 200);
        let upload = format!("POST /{}/upload/part/map.datx HTTP/1.1", "a".repeat(32));
        assert_eq!(
            admit(&[&upload, HOST, ORIGIN]),
            Ok(Route::Upload(Role::Part, "map.datx".into()))
        );
    }

    #[test]
    fn another_host_origin_or_token_is_refused() {
        let page = format!("GET /{}/state HTTP/1.1", "a".repeat(32));
        let part = format!("POST /{}/part HTTP/1.1", "a".repeat(32));
        for lines in [
            &[&page[..]][..],
            &[&page, "Host: evil.example:8123"],
            &[&page, "Host: 127.0.0.1"],
            &[&page, "Host: 127.0.0.1:8124"],
            &[&page, HOST, "Origin: http://evil.example"],
            &[&page, HOST, "Origin: null"],
            &[&page, HOST, "Sec-Fetch-Site: cross-site"],
            &[&part, HOST],
            &[&part, HOST, "Origin: http://localhost:8123"],
            &[&part, HOST, "Origin: http://127.0.0.1:8123.evil.example"],
            &["GET / HTTP/1.1", HOST],
            &["GET /state HTTP/1.1", HOST],
            &["GET /aaaa/state HTTP/1.1", HOST],
        ] {
            assert!([403, 404].contains(&status(lines)), "{lines:?}");
        }
        assert_eq!(status(&[&page, HOST, HOST]), 400);
        assert_eq!(status(&[&page.replace("GET", "DELETE"), HOST]), 405);
        // The report has a program of its own: with its token it can do nothing else.
        let report = format!("GET /{}/report.html HTTP/1.1", "b".repeat(32));
        assert_eq!(admit(&[&report, HOST]), Ok(Route::Report));
        assert_eq!(status(&[&report.replace("report.html", "state"), HOST]), 403);
        assert_eq!(status(&[&report.replace("GET", "POST"), HOST, ORIGIN]), 403);
    }

    #[test]
    fn a_path_that_leaves_its_folder_is_refused() {
        for path in [
            "../session.json",
            "upload/part/..",
            "upload/part/../../x",
            "upload/part/%2e%2e%2fx",
            "upload/part//etc/passwd",
            "upload/part/.hidden",
            "upload/part/-flag",
            "upload/part/a\\b",
            "upload/part/C:x",
            "upload/other/x",
            "upload/part/",
            "map/../../x",
            "path/..",
            "path/../../x",
            "upload/after/..",
            "next.html",
            "pipeline/..",
            "page.js/..",
            "",
        ] {
            let line = format!("POST /{}/{path} HTTP/1.1", "a".repeat(32));
            assert!([400, 404].contains(&status(&[&line, HOST, ORIGIN])), "{path}");
        }
        assert!(check_file_name(&"x".repeat(MOST_NAME_BYTES + 1)).is_err());
    }

    #[test]
    fn a_body_has_a_length_within_its_limit() {
        let length = |line: &str| {
            let text = format!("POST / HTTP/1.1\r\n{line}\r\n\r\n");
            Head::read(text.as_bytes()).unwrap().body_bytes(100).map_err(|e| e.status)
        };
        assert_eq!(length("Content-Length: 100"), Ok(100));
        assert_eq!(length("Accept: x"), Ok(0));
        assert_eq!(length("Content-Length: 101"), Err(413));
        assert_eq!(length("Content-Length: 99999999999999999999"), Err(400));
        assert_eq!(length("Content-Length: +1"), Err(400));
        assert_eq!(length("Content-Length: 1\r\nContent-Length: 2"), Err(400));
        assert_eq!(length("Transfer-Encoding: chunked"), Err(411));
    }

    /// Number of mutated requests. Larger: a longer test. Smaller: rare faults of the parser are found less often.
    const MUTATIONS: u64 = 10_000;

    #[test]
    fn mutated_requests_never_break_the_guard() {
        let base = format!(
            "POST /{}/upload/part/map.datx HTTP/1.1\r\n{HOST}\r\n{ORIGIN}\r\nContent-Length: 3\r\n\r\n",
            "a".repeat(32)
        );
        // Knuth's linear congruence, so that a fault can be made again.
        let mut state = 68_u64;
        let mut random = |below: usize| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % below
        };
        for _ in 0..MUTATIONS {
            let mut bytes = base.clone().into_bytes();
            for _ in 0..=random(6) {
                let place = random(bytes.len());
                match random(4) {
                    0 => bytes[place] = random(256) as u8,
                    1 => drop(bytes.remove(place)),
                    2 => bytes.insert(place, b"/.%\\\0\r\n "[random(8)]),
                    _ => bytes.splice(place..place, *b"../").for_each(drop),
                }
            }
            let Ok(head) = Head::read(&bytes) else { continue };
            let _ = head.body_bytes(MOST_UPLOAD_BYTES);
            if let Ok(Route::Upload(_, name)) = guard().admit(&head) {
                assert!(!name.contains(['/', '\\', '\0']) && name != ".." && name != ".", "{name}");
            }
        }
    }
}
