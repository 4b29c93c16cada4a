//! An HTTP server that hands each request to the test, which answers it when it likes.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, channel};

use anyhow::{Context as _, Result};

/// A request as it came, with the connection that waits for its answer.
#[derive(Debug)]
pub struct Received {
    /// Path and query.
    pub path: String,
    headers: BTreeMap<String, String>,
    /// As long as `Content-Length` says.
    pub body: Vec<u8>,
    connection: TcpStream,
}

impl Received {
    fn read(connection: TcpStream) -> Result<Self> {
        let mut reader = BufReader::new(connection.try_clone()?);
        let mut line = String::new();
        reader.read_line(&mut line)?;
        let path = line.split(' ').nth(1).unwrap_or_default().to_owned();
        let mut headers = BTreeMap::new();
        loop {
            let mut line = String::new();
            reader.read_line(&mut line)?;
            let Some((name, value)) = line.trim_end().split_once(": ") else {
                break;
            };
            headers.insert(name.to_ascii_lowercase(), value.to_owned());
        }
        let length = headers.get("content-length").context("no length")?;
        let mut body = vec![0; length.parse()?];
        reader.read_exact(&mut body)?;
        Ok(Self {
            path,
            headers,
            body,
            connection,
        })
    }

    /// A header's value, or "".
    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", String::as_str)
    }

    /// Answers with a status and what headers follow it, and no body.
    pub fn answer(self, head: &str) -> Result<()> {
        self.begin_answer(&format!(
            "{head}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
        ))
        .map(drop)
    }

    /// Sends the beginning of an answer, and keeps the connection.
    pub fn begin_answer(mut self, text: &str) -> Result<Self> {
        self.connection
            .write_all(format!("HTTP/1.1 {text}").as_bytes())?;
        Ok(self)
    }
}

/// Listens on `address` from now on, until the test ends.
pub fn receiver(address: &str) -> Result<Receiver<Received>> {
    let listener = TcpListener::bind(address)?;
    let (sender, received) = channel();
    std::thread::Builder::new()
        .name("receiver".to_owned())
        .spawn(move || {
            for connection in listener.incoming().flatten() {
                // What is no request is not for the test.
                let Ok(request) = Received::read(connection) else {
                    continue;
                };
                if sender.send(request).is_err() {
                    return;
                }
            }
        })?;
    Ok(received)
}
