//! Connections: one request and one answer each.

use std::{
    io::{self, Read, Write},
    net::{TcpListener, TcpStream},
    sync::Arc,
    thread,
    time::Duration,
};

use planish_app::{
    guard::{Head, MOST_HEAD_BYTES},
    refusal::Refusal,
};
use planish_handoff::Failure;

use super::{
    answer::{Answer, respond},
    server::Server,
};

/// Largest number of connections at a time. Larger: more threads for somebody who opens many. Smaller: a browser with
/// several tabs waits.
const MOST_CONNECTIONS: usize = 64;
/// Longest pause within a request. Larger: an idle connection keeps its thread for longer. Smaller: an upload from a slow
/// disk is cut off.
const PATIENCE: Duration = Duration::from_secs(20);
/// Largest number of bytes that are read and dropped after an answer, so that the browser reads the answer before the
/// connection ends. Chosen: more than a browser sends before it listens.
const MOST_DROPPED_BYTES: u64 = 4 << 20;

/// Answers requests until the process ends, each connection in a thread of its own.
///
/// # Errors
/// Fails if the system gives no thread.
pub fn listen(listener: &TcpListener, server: &Arc<Server>) -> Result<(), Failure> {
    let open = Arc::new(());
    for stream in listener.incoming() {
        // A connection that ended before it began concerns nobody else.
        let Ok(mut stream) = stream else { continue };
        // Every thread holds one more reference, until it ends.
        if Arc::strong_count(&open) > MOST_CONNECTIONS {
            let refusal = Refusal::new(503, "too many connections; close a tab");
            let _ = Answer::of_refusal(&refusal).write(&mut stream);
            continue;
        }
        let (held, server) = (Arc::clone(&open), Arc::clone(server));
        thread::Builder::new().spawn(move || {
            // A browser that has gone needs no answer.
            let _ = serve(stream, &server);
            drop(held);
        })?;
    }
    Ok(())
}

/// Reads a request, and writes its answer.
fn serve(mut stream: TcpStream, server: &Arc<Server>) -> io::Result<()> {
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let answer = match read_head(&mut stream)? {
        None => Answer::of_refusal(&Refusal::new(431, "the head of the request is too long")),
        Some((head, rest)) => match Head::read(&head) {
            Err(refusal) => Answer::of_refusal(&refusal),
            Ok(head) => {
                if head.header("expect").is_ok_and(|value| value.is_some()) {
                    stream.write_all(b"HTTP/1.1 100 Continue\r\n\r\n")?;
                }
                let mut body = rest.as_slice().chain(&mut stream);
                respond(server, &head, &mut body)
            }
        },
    };
    answer.write(&mut stream)?;
    stream.shutdown(std::net::Shutdown::Write)?;
    stream.set_read_timeout(Some(Duration::from_millis(200)))?;
    io::copy(&mut stream.take(MOST_DROPPED_BYTES), &mut io::sink())?;
    Ok(())
}

/// Reads up to the empty line that ends the head, and returns the head and what was read after it. `None` if the head is
/// too long.
fn read_head(stream: &mut TcpStream) -> io::Result<Option<(Vec<u8>, Vec<u8>)>> {
    let mut bytes = Vec::new();
    let mut part = [0; 4096];
    loop {
        if let Some(end) = bytes.windows(4).position(|four| four == b"\r\n\r\n") {
            let rest = bytes.split_off(end + 4);
            return Ok(Some((bytes, rest)));
        }
        if bytes.len() > MOST_HEAD_BYTES {
            return Ok(None);
        }
        match stream.read(&mut part)? {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            read => bytes.extend_from_slice(&part[..read]),
        }
    }
}
