/* Faults for one process, by LD_PRELOAD: its writes below a folder fail or are lost.

   FAULTS_DIR   the folder
   FAULTS_AT    the number of bytes written below it before the fault
   FAULTS_KIND  full: the disk stays full; eio: one write fails; short: one write accepts half
                of its data; kill: the process is killed
   FAULTS_LOG   a file that gets a line for each write, fsync and rename below the folder */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static long long written, at = -1;
static int is_over, is_full, log_file = -1;
static const char *folder, *kind = "";
static ssize_t (*real_write)(int, const void *, size_t);

__attribute__((constructor)) static void begin(void)
{
    real_write = dlsym(RTLD_NEXT, "write");
    folder = getenv("FAULTS_DIR");
    if (getenv("FAULTS_KIND"))
        kind = getenv("FAULTS_KIND");
    if (getenv("FAULTS_AT"))
        at = atoll(getenv("FAULTS_AT"));
    if (getenv("FAULTS_LOG"))
        log_file = open(getenv("FAULTS_LOG"), O_WRONLY | O_CREAT | O_APPEND, 0666);
    unsetenv("LD_PRELOAD");
}

static int is_below(const char *path)
{
    return folder && !strncmp(path, folder, strlen(folder)) && path[strlen(folder)] == '/';
}

static int path_of(int file, char *path)
{
    char name[64];
    snprintf(name, sizeof name, "/proc/self/fd/%d", file);
    ssize_t length = readlink(name, path, 4095);
    path[length > 0 ? length : 0] = 0;
    return length > 0;
}

static void note(const char *what, const char *one, const char *two)
{
    char line[8300];
    if (log_file >= 0) {
        int length = snprintf(line, sizeof line, "%s\t%s\t%s\n", what, one, two);
        real_write(log_file, line, length);
    }
}

static void absolute(const char *path, char *out)
{
    char here[2048];
    if (*path == '/' || !getcwd(here, sizeof here))
        snprintf(out, 4096, "%s", path);
    else
        snprintf(out, 4096, "%s/%s", here, path);
}

ssize_t write(int file, const void *data, size_t size)
{
    char path[4096];
    if (!path_of(file, path) || !is_below(path))
        return real_write(file, data, size);
    pthread_mutex_lock(&lock);
    ssize_t result;
    if (is_full) {
        result = -1;
        errno = ENOSPC;
    } else if (at >= 0 && !is_over && written + (long long)size > at) {
        is_over = 1;
        size_t part = (size_t)(at - written);
        if (!strcmp(kind, "eio")) {
            result = -1;
            errno = EIO;
        } else {
            if (!strcmp(kind, "short"))
                part = size / 2;
            result = part ? real_write(file, data, part) : 0;
            note("write", path, "");
            is_full = !strcmp(kind, "full");
            if (!strcmp(kind, "kill"))
                kill(getpid(), SIGKILL);
            if (!part && is_full) {
                result = -1;
                errno = ENOSPC;
            } else if (!part) {
                result = real_write(file, data, size);
            }
        }
    } else {
        result = real_write(file, data, size);
        note("write", path, "");
    }
    if (result > 0)
        written += result;
    int problem = errno;
    pthread_mutex_unlock(&lock);
    errno = problem;
    return result;
}

int posix_fallocate(int file, off_t from, off_t size)
{
    int (*real)(int, off_t, off_t) = dlsym(RTLD_NEXT, "posix_fallocate");
    char path[4096];
    return is_full && path_of(file, path) && is_below(path) ? ENOSPC : real(file, from, size);
}

int posix_fallocate64(int file, off64_t from, off64_t size)
{
    int (*real)(int, off64_t, off64_t) = dlsym(RTLD_NEXT, "posix_fallocate64");
    char path[4096];
    return is_full && path_of(file, path) && is_below(path) ? ENOSPC : real(file, from, size);
}

int fsync(int file)
{
    int (*real)(int) = dlsym(RTLD_NEXT, "fsync");
    char path[4096];
    int result = real(file);
    if (path_of(file, path) && (is_below(path) || (folder && !strcmp(path, folder))))
        note("fsync", path, "");
    return result;
}

int rename(const char *from, const char *to)
{
    int (*real)(const char *, const char *) = dlsym(RTLD_NEXT, "rename");
    char one[4096], two[4096];
    absolute(from, one);
    absolute(to, two);
    int result = real(from, to);
    if (!result && is_below(two))
        note("rename", one, two);
    return result;
}
