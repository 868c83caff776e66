/* Records what a program does to the files of one directory; see power_loss.py. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>
static char names[1024][512]; static int out = -1; static const char *dir;
__attribute__((constructor)) static void begin(void) {
  dir = getenv("RECORD_DIR"); const char *log = getenv("RECORD_LOG");
  if (log) out = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY|O_CREAT|O_APPEND|O_CLOEXEC, 0600);
}
static void note(const char *op, const char *path, long at, const void *data, long size) {
  char head[1200]; if (out < 0 || !dir || strncmp(path, dir, strlen(dir))) return;
  int n = snprintf(head, sizeof head, "%s\t%s\t%ld\t%ld\n", op, path, at, size);
  syscall(SYS_write, out, head, n); if (data && size > 0) syscall(SYS_write, out, data, size);
}
static void opened(int fd, const char *path, int flags, int fresh) {
  if (fd < 0 || fd >= 1024) return; names[fd][0] = 0;
  if (path[0] == '/') { strncpy(names[fd], path, 511); }
  if (fresh) note("create", path, 0, 0, 0);
  if (flags & O_TRUNC) note("truncate", path, 0, 0, 0);
}
#define OPEN(NAME) int NAME(const char *p, int f, ...) { va_list a; va_start(a, f); \
  int m = va_arg(a, int); va_end(a); int fresh = (f & O_CREAT) && access(p, F_OK); \
  int fd = syscall(SYS_openat, AT_FDCWD, p, f, m); opened(fd, p, f, fresh); return fd; }
OPEN(open) OPEN(open64)
static const char *of(int fd) { return fd >= 0 && fd < 1024 ? names[fd] : ""; }
#define REAL(R, N, ...) static R (*real)(__VA_ARGS__); if (!real) real = dlsym(RTLD_NEXT, N)
#define PWRITE(NAME) ssize_t NAME(int fd, const void *b, size_t n, off_t at) { \
  REAL(ssize_t, #NAME, int, const void *, size_t, off_t); \
  ssize_t r = real(fd, b, n, at); if (r > 0) note("write", of(fd), at, b, r); return r; }
PWRITE(pwrite) PWRITE(pwrite64)
ssize_t write(int fd, const void *b, size_t n) {
  long at = of(fd)[0] ? lseek(fd, 0, SEEK_CUR) : 0; ssize_t r = syscall(SYS_write, fd, b, n);
  if (r > 0 && of(fd)[0]) note("write", of(fd), at < 0 ? 0 : at, b, r); return r; }
#define SYNC(NAME) int NAME(int fd) { REAL(int, #NAME, int); note("sync", of(fd), 0, 0, 0); \
  return real(fd); }
SYNC(fsync) SYNC(fdatasync)
#define TRUNC(NAME) int NAME(int fd, off_t n) { REAL(int, #NAME, int, off_t); \
  note("truncate", of(fd), n, 0, 0); return real(fd, n); }
TRUNC(ftruncate) TRUNC(ftruncate64)
int unlink(const char *p) { REAL(int, "unlink", const char *); int r = real(p);
  if (!r) note("unlink", p, 0, 0, 0); return r; }
int rename(const char *a, const char *b) { REAL(int, "rename", const char *, const char *);
  int r = real(a, b); if (!r) note("rename", a, 0, b, strlen(b)); return r; }
int close(int fd) { if (fd >= 0 && fd < 1024) names[fd][0] = 0; return syscall(SYS_close, fd); }
