//! The server of a session: its flags, its start and its end.

mod answer;
mod connection;
mod estimate;
mod files;
mod job;
mod map;
mod server;

use std::{
    net::{Ipv4Addr, TcpListener},
    path::PathBuf,
};

use clap::Args;
use planish_handoff::{Failure, Status, say, system};

use self::{files::Files, server::Server};

#[derive(Args)]
pub struct ServeArguments {
    /// Directory of the session: uploaded files, results, session.json and session.sh
    #[arg(value_name = "DIR", default_value = "planish-session")]
    dir: PathBuf,
    /// Port on 127.0.0.1; a free one if 0
    #[arg(long, value_name = "N", default_value_t = 0)]
    port: u16,
    /// Do not open the browser; open the address that is printed
    #[arg(long)]
    no_browser: bool,
}

impl ServeArguments {
    pub fn run(&self) -> Result<Status, Failure> {
        let files = Files::open(&self.dir)?;
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, self.port)).map_err(|e| {
            Failure::new(format!("port {}: cannot listen: {e}; give another --port", self.port))
        })?;
        let port = listener.local_addr()?.port();
        let server = Server::open(files, port)?;
        let address = format!("http://127.0.0.1:{port}{}", server.guard.page());
        say(format!("planish app: {address}"));
        say(
            "planish app: the address is for you alone; Ctrl-C ends the page, and the session stays",
        );
        if !self.no_browser && !system::open_in_browser(&address) {
            say("planish app: no browser was found; open the address yourself");
        }
        connection::listen(&listener, &server)?;
        Ok(Status::Done)
    }
}
