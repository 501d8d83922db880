from flashdex.rollouts.verify import verify_run
import time

def test_x(converted_run, truth):
    print(open(converted_run/"conversions.jsonl").read()[:1500])
    import subprocess; print(subprocess.run(["find",str(converted_run)],capture_output=True,text=True).stdout)
    for t in (truth,None):
        t0=time.time()
        v = verify_run(converted_run, t)
        print(time.time()-t0)
        for r in v.rollouts: print(r.motion,r.stored,r.found,r.holds)
        for f in v.findings: print(f)
