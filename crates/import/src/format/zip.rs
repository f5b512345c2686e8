//! Members of a ZIP archive, stored or deflated. Source: PKWARE's APPNOTE, "General Format of a .ZIP file".

use flate2::{Crc, Decompress, FlushDecompress};
use planish_types::Invalid;

use crate::{
    budget::{MOST_ARRAYS, too_many},
    bytes::Bytes,
};

pub(crate) const MAGIC: &[u8] = b"PK\x03\x04";
const END: &[u8] = b"PK\x05\x06";

/// Size of the record at the end of an archive, and of the longest comment after it (`LONGEST_COMMENT`), bytes
/// (APPNOTE).
const END_BYTES: usize = 22;
const LONGEST_COMMENT: usize = 0xffff;

/// Largest number of bytes that one byte of deflated data can become; a member that claims more is refused.
const MOST_GROWTH: u64 = 1032;

/// A ZIP archive: its bytes, and the list of its members.
pub(crate) struct Archive<'a> {
    b: Bytes<'a>,
    members: Vec<Member>,
}

struct Member {
    name: String,
    method: u16,
    crc: u32,
    packed: usize,
    size: usize,
    start: usize,
}

impl<'a> Archive<'a> {
    /// Reads the directory at the end of `bytes`; `name` is the subject of messages. Refuses a damaged archive, and one
    /// of too many members.
    pub fn open(bytes: &'a [u8], name: &'static str) -> Result<Self, Invalid> {
        let b = Bytes { all: bytes, name, big_endian: false };
        let from = bytes.len().saturating_sub(END_BYTES + LONGEST_COMMENT);
        let end = bytes[from..].windows(END.len()).rposition(|w| w == END);
        let end = from
            + end.ok_or_else(|| {
                let problem = "has no directory at its end: it is truncated, or no ZIP archive";
                Invalid::whole(name, problem, "export it again")
            })?;
        let count = usize::from(b.u16(end + 10)?);
        let mut start = b.u32(end + 16)? as usize;
        if count > MOST_ARRAYS {
            return Err(too_many(name, MOST_ARRAYS, "members", "export only the map"));
        }
        let mut members = Vec::new();
        for _ in 0..count {
            if b.slice(start, 4)? != b"PK\x01\x02" {
                let problem = format!("has no entry of its directory at byte {start}");
                return Err(Invalid::whole(name, problem, "export it again"));
            }
            let lengths = [28, 30, 32].map(|k| b.u16(start + k).map(usize::from));
            let [name_len, extra, comment] = lengths;
            let name_len = name_len?;
            members.push(Member {
                name: b.text(start + 46, name_len)?,
                method: b.u16(start + 10)?,
                crc: b.u32(start + 16)?,
                packed: b.u32(start + 20)? as usize,
                size: b.u32(start + 24)? as usize,
                start: b.u32(start + 42)? as usize,
            });
            start += 46 + name_len + extra? + comment?;
        }
        Ok(Self { b, members })
    }

    /// Returns true if the archive has a member called `name`.
    pub fn has(&self, name: &str) -> bool {
        self.members.iter().any(|member| member.name == name)
    }

    /// Returns the names of the members, each with the size of its content, bytes.
    pub fn names(&self) -> impl Iterator<Item = (&str, usize)> {
        self.members.iter().map(|member| (member.name.as_str(), member.size))
    }

    /// Returns the content of the member `name` of at most `most` bytes. Refuses a member that is absent, larger,
    /// damaged, or packed by another method than deflate.
    pub fn member(&self, name: &str, most: usize) -> Result<Vec<u8>, Invalid> {
        let refuse = |problem: String| Invalid::whole(self.b.name, problem, "export it again");
        let wanted = name.trim_start_matches(['/', '.']);
        let short: String = wanted.chars().take(80).collect();
        let Some(member) = self.members.iter().find(|member| member.name == wanted) else {
            return Err(refuse(format!("has no member \"{short}\"")));
        };
        if member.size > most {
            let problem = format!("has {} bytes in \"{short}\", more than {most}", member.size);
            return Err(refuse(problem));
        }
        // The local header repeats the name and has an extra field of its own.
        if self.b.slice(member.start, 4)? != MAGIC {
            return Err(refuse(format!("has no \"{short}\" at byte {}", member.start)));
        }
        let name_len = usize::from(self.b.u16(member.start + 26)?);
        let extra = usize::from(self.b.u16(member.start + 28)?);
        let start = member.start + 30 + name_len + extra;
        let packed = self.b.slice(start, member.packed)?;
        // Deflate does not grow further, so memory is taken for what is there, not for what is claimed.
        if member.size as u64 > MOST_GROWTH * (packed.len() as u64 + 1) {
            let problem =
                format!("claims {} bytes of \"{short}\" in {}", member.size, packed.len());
            return Err(refuse(problem));
        }
        let content = match member.method {
            0 => packed.to_vec(),
            8 => {
                let mut content = Vec::with_capacity(member.size + 1);
                Decompress::new(false)
                    .decompress_vec(packed, &mut content, FlushDecompress::Finish)
                    .map_err(|e| refuse(format!("is broken in \"{short}\" ({e})")))?;
                content
            }
            other => return Err(refuse(format!("has \"{short}\" packed by method {other}"))),
        };
        let mut crc = Crc::new();
        crc.update(&content);
        if content.len() != member.size || crc.sum() != member.crc {
            return Err(refuse(format!("is broken in \"{short}\": its checksum is another")));
        }
        Ok(content)
    }
}
